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

from emulator.fem.formulations import Linearised, formulation_of
from emulator.fem.linear import Outcome
from emulator.fem.loop import compiled, cond
from emulator.fem.state import NewtonState
from emulator.fem.system import System

_SINGULAR = 1e13  # a step this much longer than force over stiffness: a singular tangent


class Direction(NamedTuple):
    """Newton's full step, and what judges how much of it to take.

    move : (n, 3) mm. equations : that it solves. slope : residual . move in mN mm, before the move
    was reversed. settled : whether the supports are where they belong. singular : whether the
    tangent is. definite : whether a factorisation found it positive definite. refused : whether
    there is no step, because it is not and only such a one was wanted. descends : whether the
    tangent's own direction lowers the potential, as far as that is known and asked.
    """

    move: jax.Array
    equations: Linearised
    slope: jax.Array
    settled: jax.Array
    singular: jax.Array
    definite: jax.Array
    refused: jax.Array
    descends: jax.Array


def newton_direction(
    system: System, theta: jax.Array, state: NewtonState, *, any_tangent: jax.Array | bool
) -> Direction:
    """Newton's step at ``state``, reversed where it would climb the potential.

    any_tangent : whether a tangent that is not positive definite will do.
    """
    settled = system.supports_met(state.u, theta, state.level)
    equations = formulation_of(system).linearise(state, theta)
    force = equations.residual + equations.pull
    full, outcome = system.attempt(equations.tangent, -force)
    indefinite = outcome == Outcome.INDEFINITE
    again = indefinite & any_tangent
    full = cond(again, lambda: system.solve(equations.tangent, -force), lambda: full)
    saddle = state.iterates is not None
    turns = settled & (not saddle)
    move, slope, singular = _full_step(
        system, state.u, theta, state.level, equations._replace(eliminated=None), turns, full
    )
    refused = indefinite & ~again
    descends = ~settled | (slope <= 0.0) | saddle
    return Direction(move, equations, slope, settled, singular, ~indefinite, refused, descends)


@compiled
def _full_step(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    level: jax.Array,
    equations: Linearised,
    turns: jax.Array,
    move: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Step (n, 3), residual . step before any reversal, and whether the tangent is singular.

    turns : whether a step that climbs is reversed. move : (f,) solves for the residual.
    """
    force = equations.residual + equations.pull
    slope = jnp.vdot(equations.residual, move)
    singular = _is_singular(equations.tangent, move, force)
    move = jnp.where(turns & (slope > 0.0), -move, move)
    move = system.extend(move) + system.support_offset(u, theta, level)
    solvable = equations.solvable
    return jnp.where(solvable, move, jnp.nan), slope, ~solvable | singular


def _is_singular(tangent: jax.Array, move: jax.Array, force: jax.Array) -> jax.Array:
    """Whether a step is so long for its force that the tangent must be singular."""
    size = jnp.max(jnp.abs(tangent)) * jnp.max(jnp.abs(move))
    return ~(size <= _SINGULAR * jnp.max(jnp.abs(force)))
