"""Load levels: when one is solved or given up, which comes next, and when the iteration ends.

The whole load is tried at once unless the options say otherwise. A level that does not converge is
tried again with half the load increment; an easy one earns a longer next increment. Where the
loading path is to be followed, a level whose way is not convex is given up too, as long as its
increment is not small.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.newton.step_length import Outcome
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Status
from emulator.fem.state import NewtonState

# Shortened steps after which elements flattened again and again show that a level leads nowhere:
# a lower load finds out sooner.
_MOST_FLATTENED = 8
# A load step towards a saddle that works takes about ten (docs/experiments.md, "Mean dilatation
# from far away").
_SADDLE_ITERATIONS = 20
_EASY = 8  # iterations of a level that earns twice the increment
_SLOW = 0.3  # of the residual left by a step with its own tangent: round-off, or far away


class Verdict(NamedTuple):
    """Whether a level is solved or given up; neither where the iteration goes on.

    round_off : whether it is solved because what is left may be round-off.
    """

    solved: jax.Array
    failed: jax.Array
    round_off: jax.Array


def judge_level(
    state: NewtonState, outcome: Outcome, move: jax.Array, options: NewtonOptions
) -> Verdict:
    """Whether the level of ``state`` is solved or given up after ``outcome``.

    move : (n, 3) mm, Newton's full step from ``state``.
    """
    error, at_level = outcome.error, state.at_level + 1
    slow = state.refresh & (error > _SLOW * state.error) & (at_level > 1)
    met = jnp.isfinite(state.error) & jnp.isfinite(error)
    round_off = met & _is_round_off(state, move)
    solved = (error <= options.tolerance) | (slow & (error <= options.round_off)) | round_off
    solved |= met & (jnp.linalg.norm(outcome.residual) <= options.absolute)
    stuck = state.refresh & ~(outcome.fraction > 0.0)
    spent = at_level >= options.level_iterations
    if state.iterates is not None:
        spent |= at_level >= _SADDLE_ITERATIONS
    spent |= (_flattened(state, outcome) >= _MOST_FLATTENED) & (
        _halved(state) >= options.min_increment
    )
    spent |= ~_convex(state, outcome, options) & (_halved(state) >= state.careful)
    return Verdict(solved, ~solved & (stuck | spent), round_off)


def _is_round_off(state: NewtonState, move: jax.Array) -> jax.Array:
    """Whether both the residual and what Newton's step makes of it may be round-off."""
    quiet = jnp.linalg.norm(state.residual) <= state.negligible.residual
    return quiet & (jnp.max(jnp.abs(move)) <= state.negligible.correction)


@partial(jax.jit, static_argnames="options")
def next_state(
    state: NewtonState,
    outcome: Outcome,
    descends: jax.Array,
    move: jax.Array,
    options: NewtonOptions,
) -> NewtonState:
    """Stay, move on to a higher load level, or fall back to a lower one.

    descends : whether the tangent's own direction lowers the potential, as far as that is known.
    move : (n, 3) mm, the full step.
    """
    state = state._replace(convex=state.convex & (descends | _quiet(state, options)))
    solved, failed, round_off = judge_level(state, outcome, move, options)
    complete, moved = solved & (state.level >= 1.0), solved | failed
    iterations = state.iterations + 1
    reached = jnp.where(solved, state.level, state.reached)
    u_reached = jnp.where(solved, outcome.u, state.u_reached)
    increment = _increment(state, solved, failed, options)
    crushed = jnp.where(failed, outcome.crushed, state.crushed)
    given_up = failed & (increment < options.min_increment)
    status = jnp.where(iterations >= options.max_iterations, Status.ITERATION_LIMIT, Status.RUNNING)
    status = jnp.where(given_up, _failure(state.singular, crushed), status)
    status = jnp.where(complete, Status.CONVERGED, status)
    return state._replace(
        u=jnp.where(failed, u_reached, outcome.u),
        level=jnp.where(moved & ~complete, jnp.minimum(1.0, reached + increment), state.level),
        u_reached=u_reached,
        reached=reached,
        increment=increment,
        at_level=jnp.where(moved, 0, state.at_level + 1),
        iterations=iterations,
        factorisations=state.factorisations + state.refresh,
        residual=outcome.residual,
        error=jnp.where(round_off, 0.0, outcome.error),
        refresh=moved | ~_keeps_tangent(state, outcome, options),
        convex=(moved & ~complete) | _convex(state, outcome, options),
        crushed=crushed,
        flattened=jnp.where(moved, 0, _flattened(state, outcome)),
        status=jnp.asarray(status, dtype=state.status.dtype),
    )


def _halved(state: NewtonState) -> jax.Array:
    return 0.5 * (state.level - state.reached)


def _flattened(state: NewtonState, outcome: Outcome) -> jax.Array:
    return state.flattened + (outcome.crushed & (outcome.fraction < 0.5))


def _increment(
    state: NewtonState, solved: jax.Array, failed: jax.Array, options: NewtonOptions
) -> jax.Array:
    """Load increment after this iteration: longer after easy levels, half after failures."""
    easy = solved & (state.at_level + 1 <= _EASY)
    longer = jnp.minimum(2.0 * state.increment, options.increment)
    return jnp.where(failed, _halved(state), jnp.where(easy, longer, state.increment))


def _failure(singular: jax.Array, crushed: jax.Array) -> jax.Array:
    """The status that names why the smallest load increment failed."""
    limit = jnp.where(crushed, Status.INVERTED_ELEMENT, Status.LOAD_LIMIT)
    return jnp.where(singular, Status.SINGULAR_TANGENT, limit)


def _keeps_tangent(state: NewtonState, outcome: Outcome, options: NewtonOptions) -> jax.Array:
    """Whether the next step may use this tangent again: most of its cost is the factorisation."""
    good = (outcome.fraction == 1.0) & jnp.isfinite(outcome.error)
    good &= outcome.error <= options.keep_tangent * state.error
    return good & state.alone


def _quiet(state: NewtonState, options: NewtonOptions) -> jax.Array:
    """Whether round-off decides which way a step goes."""
    return state.error <= options.round_off


def _convex(state: NewtonState, outcome: Outcome, options: NewtonOptions) -> jax.Array:
    """Whether the way so far was convex, and this step a full one.

    A step with a kept tangent that will not do is replaced, not cut short.
    """
    whole = (outcome.fraction == 1.0) | _quiet(state, options)
    return state.convex & (~state.refresh | whole)
