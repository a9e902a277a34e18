r"""Load stepping: Newton's method at load factors that rise to the full load.

The full load is tried at once unless the options say otherwise. A load level that does not converge
is tried again with half the increment, from the last level that did; after an easy one the next
increment is longer. A level is given up when

* no part of a step with a new tangent makes progress,
* it has taken its iterations,
* inverting elements have shortened its steps again and again, or
* a tangent was indefinite or a step shortened, where the increment is to stay small enough for the
  loading path to be followed (:attr:`~emulator.fem.state.LoadHistory.largest_indefinite`).

One iteration is a pure function of the state, so that it can be compiled into a loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.compiled import cond
from emulator.fem.formulations import formulation_of
from emulator.fem.newton import Direction, Newton, NewtonOptions, Step
from emulator.fem.solution import Status
from emulator.fem.state import LoadHistory, NewtonState, RoundOff

# Shortened steps after which a load level ends: elements that keep inverting show that the
# increment is too large, and a lower load is cheaper.
_MOST_INVERSIONS = 8
# Iterations of a level where a saddle point is sought; a load step that works takes about ten
# (docs/experiments.md, "Mean dilatation from far away").
_SADDLE_ITERATIONS = 20
_EASY = 8  # iterations up to which a level doubles the next increment
_SLOW = 0.3  # ratio of residuals after and before a step from which the step is slow
_ROUND_OFF = 1e-15  # strain below the resolution of floating point
_SMALLEST_CORRECTION = 1e-12  # correction that may be round-off, over the body's size
_STRETCH = 1e-6  # small enough for the forces to be linear in it


class _Verdict(NamedTuple):
    """Whether a level has converged or is given up; neither where its iteration goes on.

    round_off : whether the level counts as converged because the residual may be round-off.
    """

    converged: jax.Array
    failed: jax.Array
    round_off: jax.Array


@dataclass(frozen=True, eq=False)
class LoadStepping:
    """The iteration at one theta.

    system : the equations.
    options : the controls of the iteration.
    theta : the parameters (p,).
    """

    system: System
    options: NewtonOptions
    theta: jax.Array

    @property
    def _newton(self) -> Newton:
        return Newton(self.system, self.options, self.theta)

    def begin(self, start: jax.Array, round_off: RoundOff | None = None) -> NewtonState:
        r"""Return the first state: at ``start`` (n, 3) mm, or at rest if ``start`` is not valid.

        round_off : the residual and correction that may be round-off, if known. Otherwise the
            residual is :math:`10^{-15} |K_0 X|`, the change of the internal forces in a uniform
            stretch of the body at rest by 1e-15, taken from a stretch by 1e-6. Without loads there
            is no other force to compare a residual with. On a slender body, or beside stiff
            springs, such a residual still matters, so the step for it must be short as well.
        """
        system, theta = self.system, self.theta
        if round_off is None:
            X = jnp.asarray(system.scene.mesh.nodes)
            stretched = system.balance(_STRETCH * X, theta, 0.0).internal
            size, extent = _ROUND_OFF / _STRETCH * stretched, jnp.ptp(X, axis=0).max()
            size = jnp.where(jnp.isfinite(size), size, 0.0)
            round_off = RoundOff(size, _SMALLEST_CORRECTION * extent)
        residual, relative = system.admissible_balance(start, theta, jnp.ones(()))
        state = _first_state(
            theta,
            start,
            residual,
            relative,
            round_off,
            system.least_volume_ratio(start),
            entries=len(system.pattern.rows),
            options=self.options,
        )
        return state._replace(auxiliary=formulation_of(system).begin(state.u, theta))

    def step(self, state: NewtonState, allow_indefinite: jax.Array | bool = True) -> NewtonState:
        """Return the state after one iteration.

        allow_indefinite : whether to step with a tangent that is not positive definite. Otherwise
            the state stays where it is at such a one, and is no longer monotone.
        """
        history = state.history
        residual, relative = cond(
            history.iterations == 0,
            lambda: self.system.admissible_balance(state.u, self.theta, state.load),
            lambda: (state.residual, state.relative_residual),
        )
        state = state._replace(residual=residual, relative_residual=relative)
        direction = self._newton.direction(state, allow_indefinite)
        history = history._replace(monotone=history.monotone & direction.definite)
        state = state._replace(history=history)
        return cond(direction.refused, lambda: state, lambda: self._after(state, direction))

    def _after(self, state: NewtonState, direction: Direction) -> NewtonState:
        """Return the state after the part of a step that is taken."""
        step = self._newton.take_step(state, direction)
        state = state._replace(
            tangent=direction.equations.tangent,
            history=state.history._replace(singular=direction.singular),
        )
        after = _next_state(state, step, direction.descends, direction.step, self.options)
        if state.auxiliary is None:
            return after
        return after._replace(auxiliary=self._auxiliary(state, step, direction, after))

    def _auxiliary(
        self, state: NewtonState, step: Step, direction: Direction, after: NewtonState
    ) -> Any:
        """Return the other unknowns after the step, or at the start of a new load level."""
        formulation = formulation_of(self.system)
        full = jnp.where(step.fraction > 0.0, direction.step, 0.0)
        return cond(
            after.load == state.load,
            lambda: formulation.advance(
                state.auxiliary, direction.equations.couplings, full, step.fraction
            ),
            lambda: formulation.begin(after.u, self.theta),
        )


@partial(jax.jit, static_argnames=("entries", "options"))
def _first_state(
    theta: jax.Array,
    start: jax.Array,
    residual: jax.Array,
    relative: jax.Array,
    round_off: RoundOff,
    least_J: jax.Array,
    *,
    entries: int,
    options: NewtonOptions,
) -> NewtonState:
    """Return the state at ``start`` or at rest, for tangents of ``entries`` nonzeros."""
    finite = jnp.all(jnp.isfinite(start)) & jnp.all(jnp.isfinite(theta))
    inverted = ~(least_J > 0.0)
    balanced = (relative <= options.tolerance) | (jnp.linalg.norm(residual) <= options.absolute)
    converged = ~inverted & balanced & jnp.isfinite(relative)
    status = jnp.where(converged, Status.CONVERGED, Status.RUNNING)
    u = jnp.where(finite & ~inverted, start, 0.0)
    count, increment = jnp.zeros((), dtype=int), jnp.full((), options.increment, float)
    history = LoadHistory(
        u=jnp.zeros_like(u),
        load=jnp.zeros(()),
        increment=increment,
        largest_indefinite=jnp.full((), jnp.inf, float),
        iterations=count,
        monotone=jnp.array(True),
        inversions=count,
        inverted=jnp.array(False),
        singular=jnp.array(False),
    )
    return NewtonState(
        u=u,
        auxiliary=None,
        load=increment,
        residual=residual,
        relative_residual=jnp.where(finite, relative, jnp.inf),
        round_off=round_off,
        tangent=jnp.zeros(entries),
        renew=jnp.array(True),
        iterations=count,
        factorisations=count,
        history=history,
        status=jnp.asarray(jnp.where(finite, status, Status.INVALID_INPUT), dtype=jnp.int64),
    )


@partial(jax.jit, static_argnames="options")
def _next_state(
    state: NewtonState,
    step: Step,
    descends: jax.Array,
    full: jax.Array,
    options: NewtonOptions,
) -> NewtonState:
    """Stay at the load level, go on to a higher one, or fall back to a lower one.

    descends : whether the tangent's own direction lowers the potential, as far as that is known.
    full : the full step, (n, 3) mm.
    """
    history = state.history
    monotone = history.monotone & (descends | _is_quiet(state, options))
    state = state._replace(history=history._replace(monotone=monotone))
    converged, failed, round_off = _judge(state, step, full, options)
    complete, level_ends = converged & (state.load >= 1.0), converged | failed
    iterations = state.iterations + 1
    load_reached = jnp.where(converged, state.load, history.load)
    u_reached = jnp.where(converged, step.u, history.u)
    increment = _increment(state, converged, failed, options)
    inverted = jnp.where(failed, step.inverting, history.inverted)
    given_up = failed & (increment < options.min_increment)
    status = jnp.where(iterations >= options.max_iterations, Status.ITERATION_LIMIT, Status.RUNNING)
    status = jnp.where(given_up, _failure(history.singular, inverted), status)
    status = jnp.where(complete, Status.CONVERGED, status)
    next_load = jnp.minimum(1.0, load_reached + increment)
    return state._replace(
        u=jnp.where(failed, u_reached, step.u),
        load=jnp.where(level_ends & ~complete, next_load, state.load),
        residual=step.residual,
        relative_residual=jnp.where(round_off, 0.0, step.relative_residual),
        renew=level_ends | ~_keeps_tangent(state, step, options),
        iterations=iterations,
        factorisations=state.factorisations + state.renew,
        history=history._replace(
            u=u_reached,
            load=load_reached,
            increment=increment,
            iterations=jnp.where(level_ends, 0, history.iterations + 1),
            monotone=(level_ends & ~complete) | _is_monotone(state, step, options),
            inversions=jnp.where(level_ends, 0, _inversions(state, step)),
            inverted=inverted,
        ),
        status=jnp.asarray(status, dtype=state.status.dtype),
    )


def _judge(state: NewtonState, step: Step, full: jax.Array, options: NewtonOptions) -> _Verdict:
    """Return whether the load level has converged or is given up after ``step``."""
    history, relative = state.history, step.relative_residual
    iterations, initial_residual = history.iterations + 1, state.relative_residual
    slow = state.renew & (relative > _SLOW * initial_residual) & (iterations > 1)
    finite = jnp.isfinite(initial_residual) & jnp.isfinite(relative)
    round_off = finite & _is_round_off(state, full)
    converged = (relative <= options.tolerance) | (slow & (relative <= options.round_off))
    converged |= round_off
    converged |= finite & (jnp.linalg.norm(step.residual) <= options.absolute)
    stuck = state.renew & ~(step.fraction > 0.0)
    exhausted = iterations >= options.level_iterations
    if state.auxiliary is not None:
        exhausted |= iterations >= _SADDLE_ITERATIONS
    halved = _halved_increment(state)
    exhausted |= (_inversions(state, step) >= _MOST_INVERSIONS) & (halved >= options.min_increment)
    exhausted |= ~_is_monotone(state, step, options) & (halved >= history.largest_indefinite)
    return _Verdict(converged, ~converged & (stuck | exhausted), round_off)


def _is_round_off(state: NewtonState, full: jax.Array) -> jax.Array:
    """Return whether both the residual and Newton's step for it may be round-off."""
    quiet = jnp.linalg.norm(state.residual) <= state.round_off.residual
    return quiet & (jnp.max(jnp.abs(full)) <= state.round_off.correction)


def _halved_increment(state: NewtonState) -> jax.Array:
    return 0.5 * (state.load - state.history.load)


def _inversions(state: NewtonState, step: Step) -> jax.Array:
    return state.history.inversions + (step.inverting & (step.fraction < 0.5))


def _increment(
    state: NewtonState, converged: jax.Array, failed: jax.Array, options: NewtonOptions
) -> jax.Array:
    """Return the next load increment: longer after easy levels, half after failures."""
    history = state.history
    easy = converged & (history.iterations + 1 <= _EASY)
    longer = jnp.minimum(2.0 * history.increment, options.increment)
    return jnp.where(failed, _halved_increment(state), jnp.where(easy, longer, history.increment))


def _failure(singular: jax.Array, inverted: jax.Array) -> jax.Array:
    """Return the status that names why the smallest load increment failed."""
    limit = jnp.where(inverted, Status.INVERTED_ELEMENT, Status.LOAD_LIMIT)
    return jnp.where(singular, Status.SINGULAR_TANGENT, limit)


def _keeps_tangent(state: NewtonState, step: Step, options: NewtonOptions) -> jax.Array:
    """Return whether the next step may use this tangent again."""
    good = (step.fraction == 1.0) & jnp.isfinite(step.relative_residual)
    good &= step.relative_residual <= options.keep_tangent * state.relative_residual
    return good & state.displacement_only


def _is_quiet(state: NewtonState, options: NewtonOptions) -> jax.Array:
    """Return whether round-off decides the sign of a step's slope."""
    return state.relative_residual <= options.round_off


def _is_monotone(state: NewtonState, step: Step, options: NewtonOptions) -> jax.Array:
    """Return whether all steps of the level have been monotone, and this one is full.

    A step with a kept tangent that makes no progress is replaced, not cut short.
    """
    full = (step.fraction == 1.0) | _is_quiet(state, options)
    return state.history.monotone & (~state.renew | full)
