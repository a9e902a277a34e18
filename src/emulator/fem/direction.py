r"""Descent direction of Newton's method.

.. math::
    K\, \Delta u = -\left[r_s(u) + K\, \Delta \bar u\right], \qquad
    \Delta \bar u = s \bar u - u|_\text{held}

at load level s. Where the tangent is indefinite and the direction climbs the potential, the
opposite one is taken.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.linear import Outcome
from emulator.fem.mixed import Condensed, linearise
from emulator.fem.programs import compiled, cond
from emulator.fem.state import UNBALANCED, NewtonState

_ENDLESS = 1e13  # a step this much longer than force over stiffness: a singular tangent


class Direction(NamedTuple):
    """Newton's full step, and what judges how much of it to take.

    move : (n, 3) mm. residual : (f,) mN where it starts. pull : (f,) mN, the change of the residual
    when the supports are moved. slope : residual . move in mN mm, before the move was reversed.
    settled : whether the supports are where they belong. singular : whether the tangent is.
    definite : whether a factorisation found it positive definite. refused : whether there is no
    step, because it is not and only such a one was wanted.
    tangent : (nnz,) mN/mm. condensed : the linearisation of mean dilatation, or None.
    """

    move: jax.Array
    residual: jax.Array
    pull: jax.Array
    slope: jax.Array
    settled: jax.Array
    singular: jax.Array
    definite: jax.Array
    refused: jax.Array
    tangent: jax.Array
    condensed: Condensed | None

    @property
    def descends(self) -> jax.Array:
        """Whether the tangent's own direction lowers the potential, as far as that is known."""
        if self.condensed is not None:  # the point sought by mean dilatation is a saddle
            return jnp.array(True)
        return ~self.settled | (self.slope <= 0.0)


def support_offset(system: System, u: jax.Array, level: jax.Array) -> jax.Array:
    """Distance (n, 3) in mm of the held displacements from their values at ``level``."""
    scene = system.scene
    wanted = level * scene.held_displacement
    # Comparing first: fused multiply-add finds the last bit of the product missing in the
    # difference (docs/experiments.md, "A fused multiply-add").
    return jnp.where(scene.held & (u != wanted), wanted - u, 0.0)


@compiled
def supports_met(system: System, u: jax.Array, level: jax.Array) -> jax.Array:
    """Whether the held displacements of ``u`` (n, 3) are those of ``level``, shape ()."""
    return jnp.all(support_offset(system, u, level) == 0.0)


def newton_direction(
    system: System, theta: jax.Array, state: NewtonState, *, any_tangent: jax.Array | bool
) -> Direction:
    """Newton's step at ``state``, reversed where it would climb the potential.

    any_tangent : whether a tangent that is not positive definite will do.
    """
    settled = supports_met(system, state.u, state.level)
    linearised = (
        _on_displacements(system, theta, state, settled)
        if state.volumes is None
        else _on_volumes(system, theta, state)
    )
    tangent, solvable, residual, pull, condensed = linearised
    full, outcome = system.attempt(tangent, -(residual + pull))
    indefinite = outcome == Outcome.INDEFINITE
    again = indefinite & any_tangent
    full = cond(again, lambda: system.solve(tangent, -(residual + pull)), lambda: full)
    move, slope, singular = _full_step(
        system, state.u, state.level, tangent, solvable, residual, pull, settled, full
    )
    refused = indefinite & ~again
    return Direction(
        move, residual, pull, slope, settled, singular, ~indefinite, refused, tangent, condensed
    )


@compiled
def _full_step(
    system: System,
    u: jax.Array,
    level: jax.Array,
    tangent: jax.Array,
    solvable: jax.Array,
    residual: jax.Array,
    pull: jax.Array,
    settled: jax.Array,
    move: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Step (n, 3), residual . step before any reversal, and whether the tangent is singular.

    move : (f,) solves for the residual.
    """
    slope = jnp.vdot(residual, move)
    endless = _endless(tangent, move, residual + pull)
    if not system.mixed:
        move = jnp.where(settled & (slope > 0.0), -move, move)
    move = system.extend(move) + support_offset(system, u, level)
    return jnp.where(solvable, move, jnp.nan), slope, ~solvable | endless


def _on_displacements(
    system: System, theta: jax.Array, state: NewtonState, settled: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, None]:
    """Tangent, whether it is solvable, residual, and its change as the supports are moved."""
    u = state.u
    stiffening = _stiffening(state.error, state.level)
    # A kept tangent stays the same to the bit: the solver knows its factor by its values.
    tangent, solvable = cond(
        state.refresh,
        lambda: system.safe_tangent(u, theta, stiffening),
        lambda: (state.tangent, jnp.array(True)),
    )
    pull = cond(
        settled,
        lambda: jnp.zeros_like(state.residual),
        lambda: _pull(system, u, theta, stiffening, state.level),
    )
    return tangent, solvable, state.residual, pull, None


@jax.jit
def _stiffening(error: jax.Array, level: jax.Array) -> jax.Array:
    """Load level whose stiffness the tangent holds.

    Loads that nothing balances yet lend none: a pressure softens the tangent of a body that does
    not resist it and points the step nowhere useful.
    """
    return jnp.where(error > UNBALANCED, 0.0, level)


@compiled
def _pull(
    system: System, u: jax.Array, theta: jax.Array, stiffening: jax.Array, level: jax.Array
) -> jax.Array:
    """K times the offset of the supports, (f,) mN, without assembling the held columns."""
    offset = support_offset(system, u, level)
    return jax.jvp(lambda v: system.residual(v, theta, stiffening), (u,), (offset,))[1]


@compiled
def _on_volumes(
    system: System, theta: jax.Array, state: NewtonState
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, Condensed]:
    """The same with the volumes of mean dilatation eliminated, and their linearisation."""
    assert state.volumes is not None
    u, level = state.u, state.level
    offset = support_offset(system, u, level)
    condensed = linearise(system.scene, u, state.volumes, theta)
    residual, pull = system.mixed_residual(u, theta, level, condensed, offset)
    assembled = system.assemble(condensed.tangent, u, theta, level)
    safe, solvable = system.pattern.safe_values(assembled), system.pattern.solvable(assembled)
    return safe, solvable, residual, pull, condensed


def _endless(tangent: jax.Array, move: jax.Array, force: jax.Array) -> jax.Array:
    """Whether a step is so long for its force that the tangent must be singular."""
    size = jnp.max(jnp.abs(tangent)) * jnp.max(jnp.abs(move))
    return ~(size <= _ENDLESS * jnp.max(jnp.abs(force)))
