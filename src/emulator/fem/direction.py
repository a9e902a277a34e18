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
from emulator.fem.mixed import Condensed, linearise
from emulator.fem.state import UNBALANCED, NewtonState

_ENDLESS = 1e13  # a step this much longer than force over stiffness: a singular tangent


class Direction(NamedTuple):
    """Newton's full step, and what judges how much of it to take.

    move : (n, 3) mm. residual : (f,) mN where it starts. pull : (f,) mN, the change of the residual
    when the supports are moved. slope : residual . move in mN mm, before the move was reversed.
    settled : whether the supports are where they belong. singular : whether the tangent is.
    tangent : (nnz,) mN/mm. condensed : the linearisation of mean dilatation, or None.
    """

    move: jax.Array
    residual: jax.Array
    pull: jax.Array
    slope: jax.Array
    settled: jax.Array
    singular: jax.Array
    tangent: jax.Array
    condensed: Condensed | None

    @property
    def descends(self) -> jax.Array:
        """Whether the tangent's own direction lowers the potential, as far as that is known."""
        return ~self.settled | (self.slope <= 0.0)


def support_offset(system: System, u: jax.Array, level: jax.Array) -> jax.Array:
    """Distance (n, 3) in mm of the held displacements from their values at ``level``."""
    scene = system.scene
    wanted = level * scene.held_displacement
    # Comparing first: fused multiply-add finds the last bit of the product missing in the
    # difference (docs/experiments.md, "A fused multiply-add").
    return jnp.where(scene.held & (u != wanted), wanted - u, 0.0)


def newton_direction(system: System, theta: jax.Array, state: NewtonState) -> Direction:
    """Newton's step at ``state``, reversed where it would climb the potential."""
    offset = support_offset(system, state.u, state.level)
    settled = jnp.all(offset == 0.0)
    linearised = _on_displacements if state.volumes is None else _on_volumes
    tangent, solvable, residual, pull, condensed = linearised(system, theta, state, offset)
    move = system.solve(tangent, -(residual + pull))
    slope = jnp.vdot(residual, move)
    endless = _endless(tangent, move, residual + pull)
    if condensed is None:
        move = jnp.where(settled & (slope > 0.0), -move, move)
    move = system.extend(move) + offset
    return Direction(
        move=jnp.where(solvable, move, jnp.nan),
        residual=residual,
        pull=pull,
        slope=slope,
        settled=settled,
        singular=~solvable | endless,
        tangent=tangent,
        condensed=condensed,
    )


def _checked(system: System, tangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    return system.pattern.safe_values(tangent), system.pattern.solvable(tangent)


def _on_displacements(
    system: System, theta: jax.Array, state: NewtonState, offset: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, None]:
    """Tangent, whether it is solvable, residual, and its change along ``offset`` (n, 3)."""
    u = state.u
    # Loads that nothing balances yet lend no stiffness: a pressure softens the tangent of a body
    # that does not resist it and points the step nowhere useful.
    stiffening = jnp.where(state.error > UNBALANCED, 0.0, state.level)
    # A kept tangent stays the same to the bit: the solver knows its factor by its values.
    tangent, solvable = jax.lax.cond(
        state.refresh,
        lambda: _checked(system, system.tangent(u, theta, stiffening)),
        lambda: (state.tangent, jnp.array(True)),
    )

    def pulled() -> jax.Array:
        """K times the offset, without assembling the held columns."""
        return jax.jvp(lambda v: system.residual(v, theta, stiffening), (u,), (offset,))[1]

    none = jnp.zeros_like(state.residual)
    pull = jax.lax.cond(jnp.all(offset == 0.0), lambda: none, pulled)
    return tangent, solvable, state.residual, pull, None


def _on_volumes(
    system: System, theta: jax.Array, state: NewtonState, offset: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, Condensed]:
    """The same with the volumes of mean dilatation eliminated, and their linearisation."""
    assert state.volumes is not None
    u, level = state.u, state.level
    condensed = linearise(system.scene, u, state.volumes, theta)
    residual, pull = system.mixed_residual(u, theta, level, condensed, offset)
    assembled = system.assemble(condensed.tangent, u, theta, level)
    return *_checked(system, assembled), residual, pull, condensed


def _endless(tangent: jax.Array, move: jax.Array, force: jax.Array) -> jax.Array:
    """Whether a step is so long for its force that the tangent must be singular."""
    size = jnp.max(jnp.abs(tangent)) * jnp.max(jnp.abs(move))
    return ~(size <= _ENDLESS * jnp.max(jnp.abs(force)))
