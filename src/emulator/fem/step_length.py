"""The part of a Newton step that is taken, and where it leads."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System, balance
from emulator.fem.direction import Direction, support_offset
from emulator.fem.functional import volume_ratio
from emulator.fem.line_search import choose_fraction
from emulator.fem.natural import natural_monotonicity
from emulator.fem.options import NewtonOptions
from emulator.fem.state import NEAR, NewtonState


class Outcome(NamedTuple):
    """Where a step leads.

    u : (n, 3) mm. residual : (f,) mN. error : relative to the forces at work.
    fraction : of the step that was taken; 0 where no part of it would do.
    crushed : whether elements forbade twice as much.
    """

    u: jax.Array
    residual: jax.Array
    error: jax.Array
    fraction: jax.Array
    crushed: jax.Array


def level_balance(
    system: System, u: jax.Array, theta: jax.Array, level: jax.Array, negligible: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Residual (f,) and its relative size, infinite unless finite and the supports are met."""
    residual, error = balance(system, u, theta, level, negligible)
    placed = jnp.all(support_offset(system, u, level) == 0.0)
    return residual, jnp.where(placed & jnp.isfinite(error), error, jnp.inf)


def take_step(
    system: System,
    theta: jax.Array,
    state: NewtonState,
    direction: Direction,
    options: NewtonOptions,
) -> Outcome:
    """The full step where the residual alone shows that it is good, else a line search."""
    quick = _full_step(system, theta, state, direction, options)
    # A kept tangent is worth a full step or nothing: its direction is not searched along.
    return jax.lax.cond(
        (quick.fraction > 0.0) | ~state.refresh,
        lambda: quick,
        lambda: _searched_step(system, theta, state, direction, options),
    )


def _full_step(
    system: System,
    theta: jax.Array,
    state: NewtonState,
    direction: Direction,
    options: NewtonOptions,
) -> Outcome:
    """The full step where it halves a residual that is small already."""
    near = direction.settled & (state.error < NEAR) & (not system.mixed)
    trial = state.u + direction.move
    residual, error = level_balance(system, trial, theta, state.level, state.negligible)
    J, now = (jnp.min(volume_ratio(system.scene, u)) for u in (trial, state.u))
    good = near & (error <= 0.5 * state.error) & (options.shrink * now < J)
    return Outcome(
        u=jnp.where(good, trial, state.u),
        residual=jnp.where(good, residual, state.residual),
        error=jnp.where(good, error, state.error),
        fraction=jnp.where(good, 1.0, 0.0),
        crushed=jnp.array(False),
    )


def _searched_step(
    system: System,
    theta: jax.Array,
    state: NewtonState,
    direction: Direction,
    options: NewtonOptions,
) -> Outcome:
    """The part of the step that makes most progress."""
    nearer = None
    if state.volumes is not None:
        natural = natural_monotonicity(
            system, state.u, state.volumes, state.level, theta, direction
        )
        # Where round-off is all that is left, it cannot be told from progress.
        drowned = state.error <= options.round_off
        nearer = lambda fraction: drowned | natural(fraction)  # noqa: E731
    fraction, crushed = choose_fraction(
        system, state.u, state.level, theta, direction, options.shrink, nearer
    )
    u = jnp.where(fraction > 0.0, state.u + fraction * direction.move, state.u)
    # After a full step the supports are met; setting them avoids the last bit of round-off.
    scene = system.scene
    u = jnp.where(scene.held & (fraction == 1.0), state.level * scene.held_displacement, u)
    residual, error = level_balance(system, u, theta, state.level, state.negligible)
    return Outcome(u, residual, error, fraction, crushed)
