"""The part of a Newton step that is taken, and where it leads."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.balance import level_balance
from emulator.fem.formulations import formulation_of
from emulator.fem.loop import compiled, cond, while_loop
from emulator.fem.newton.direction import Direction
from emulator.fem.newton.line_search import choose_fraction
from emulator.fem.options import NewtonOptions
from emulator.fem.state import NEAR, NewtonState
from emulator.fem.system import System


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


class _Tried(NamedTuple):
    """Where the part of a step that was tried leads; whether it was searched for, and is it."""

    outcome: Outcome
    searched: jax.Array
    done: jax.Array


def take_step(
    system: System,
    theta: jax.Array,
    state: NewtonState,
    direction: Direction,
    options: NewtonOptions,
) -> Outcome:
    """The full step where the residual alone shows that it is good, else a line search.

    A kept tangent is worth a full step or nothing: its direction is not searched along.
    """
    none = Outcome(state.u, state.residual, state.error, jnp.zeros(()), jnp.array(False))
    near = _near(direction.settled, state.error) & state.alone

    def attempt(before: _Tried) -> _Tried:
        search = before.searched | ~near
        fraction, crushed = cond(
            search,
            lambda: _searched(system, theta, state, direction, options),
            lambda: (jnp.ones(()), jnp.array(False)),
        )
        u = _moved(system, state.u, theta, direction.move, fraction, state.level)
        residual, error = level_balance(system, u, theta, state.level)
        J, now = system.least_volume_ratio(u), system.least_volume_ratio(state.u)
        good = search | _good(error, state.error, J, options.shrink, now)
        outcome = Outcome(u, residual, error, fraction, crushed)
        outcome = jax.tree.map(lambda yes, no: jnp.where(good, yes, no), outcome, none)
        return _Tried(outcome, jnp.array(True), good | ~state.refresh)

    begin = _Tried(none, jnp.array(False), ~near & ~state.refresh)
    return while_loop(lambda tried: ~tried.done, attempt, begin).outcome


@jax.jit
def _near(settled: jax.Array, error: jax.Array) -> jax.Array:
    return settled & (error < NEAR)


@jax.jit
def _good(
    error: jax.Array, before: jax.Array, J: jax.Array, shrink: float, now: jax.Array
) -> jax.Array:
    """Whether a step halves the residual and crushes no element."""
    return (error <= 0.5 * before) & (shrink * now < J)


def _searched(
    system: System,
    theta: jax.Array,
    state: NewtonState,
    direction: Direction,
    options: NewtonOptions,
) -> tuple[jax.Array, jax.Array]:
    """The part of the step that makes most progress, and whether elements forbade twice as much."""
    judge = formulation_of(system).nearer(state, theta, direction.equations, direction.move)
    nearer = None
    if judge is not None:
        # Where round-off is all that is left, it cannot be told from progress.
        unclear = state.error <= options.round_off
        nearer = lambda fraction: unclear | judge(fraction)  # noqa: E731
    return choose_fraction(system, state.u, state.level, theta, direction, options.shrink, nearer)


@compiled
def _moved(
    system: System,
    u: jax.Array,
    theta: jax.Array,
    move: jax.Array,
    fraction: jax.Array,
    level: jax.Array,
) -> jax.Array:
    """``u`` (n, 3) mm after a fraction of the step."""
    u = jnp.where(fraction > 0.0, u + fraction * move, u)
    # After a full step the supports are met; setting them avoids the last bit of round-off.
    return jnp.where(fraction == 1.0, system.scene.on_supports(u, theta, level=level), u)
