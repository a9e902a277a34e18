r"""Load stepping: Newton's method at load factors that rise to the full load.

The full load is tried at once unless the options say otherwise. A load level that does not converge
is tried again with half the increment, from the last level that did; after an easy one the next
increment is longer. A level is given up when

* no part of a step with a new tangent makes progress,
* it has taken its iterations,
* inverting elements have shortened its steps again and again, or
* a tangent was indefinite or a step shortened, where the increment is to stay small enough for the
  loading path to be followed (:attr:`~emulator.fem.solution.LoadHistory.largest_indefinite`).

One iteration is a pure function of the state, so that it can be compiled into a loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.compiled import cond
from emulator.fem.formulations import formulation_of
from emulator.fem.newton import NewtonOptions, Step, newton_step
from emulator.fem.solution import LoadHistory, NewtonState, RoundOff, Status

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


@dataclass(frozen=True, eq=False)
class LoadStepping:
    """Newton's method at one theta, from one load factor to the next.

    system : the equations.
    options : the controls of the iteration.
    theta : the parameters (p,).
    """

    system: System
    options: NewtonOptions
    theta: jax.Array

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
        balance = system.admissible_balance(start, theta, jnp.ones(()))
        least_J, entries = system.least_volume_ratio(start), len(system.pattern.rows)
        state = _first_state(
            theta, start, *balance, round_off, least_J, entries=entries, options=self.options
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
        step = newton_step(self.system, self.options, self.theta, state, allow_indefinite)
        history = history._replace(monotone=history.monotone & step.definite)
        state = state._replace(history=history)
        return cond(step.refused, lambda: state, lambda: self._after(state, step))

    def _after(self, state: NewtonState, step: Step) -> NewtonState:
        """Return the state after the part of a step that is taken."""
        state = state._replace(
            tangent=step.tangent, history=state.history._replace(singular=step.singular)
        )
        after = _next_state(state, step._replace(couplings=None), self.options)
        if state.auxiliary is None:
            return after
        # The other unknowns follow the step, or begin anew at another load level.
        formulation = formulation_of(self.system)
        full = jnp.where(step.fraction > 0.0, step.full, 0.0)
        auxiliary = cond(
            after.load == state.load,
            lambda: formulation.advance(state.auxiliary, step.couplings, full, step.fraction),
            lambda: formulation.begin(after.u, self.theta),
        )
        return after._replace(auxiliary=auxiliary)


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
def _next_state(state: NewtonState, step: Step, options: NewtonOptions) -> NewtonState:
    """Stay at the load level, go on to a higher one, or fall back to a lower one."""
    history, before, after = state.history, state.relative_residual, step.relative_residual
    finite, whole = jnp.isfinite(before) & jnp.isfinite(after), step.fraction == 1.0
    level_iterations, iterations = history.iterations + 1, state.iterations + 1
    quiet = before <= options.round_off  # round-off decides the sign of the step's slope
    # A step with a kept tangent that makes no progress is replaced, not cut short.
    monotone = history.monotone & (step.descends | quiet) & (~state.renew | whole | quiet)
    inversions = history.inversions + (step.inverting & (step.fraction < 0.5))
    halved = 0.5 * (state.load - history.load)

    # Has the load level converged, or is it given up?
    round_off = finite & (jnp.linalg.norm(state.residual) <= state.round_off.residual)
    round_off &= jnp.max(jnp.abs(step.full)) <= state.round_off.correction
    slow = state.renew & (after > _SLOW * before) & (level_iterations > 1)
    converged = (after <= options.tolerance) | (slow & (after <= options.round_off)) | round_off
    converged |= finite & (jnp.linalg.norm(step.residual) <= options.absolute)
    exhausted = level_iterations >= options.level_iterations
    if state.auxiliary is not None:
        exhausted |= level_iterations >= _SADDLE_ITERATIONS
    exhausted |= (inversions >= _MOST_INVERSIONS) & (halved >= options.min_increment)
    exhausted |= ~monotone & (halved >= history.largest_indefinite)
    failed = ~converged & (exhausted | (state.renew & ~(step.fraction > 0.0)))
    complete, level_ends = converged & (state.load >= 1.0), converged | failed

    # The next load: a longer increment after an easy level, half of it after a failure.
    load_reached = jnp.where(converged, state.load, history.load)
    u_reached = jnp.where(converged, step.u, history.u)
    longer = jnp.minimum(2.0 * history.increment, options.increment)
    easy = converged & (level_iterations <= _EASY)
    increment = jnp.where(failed, halved, jnp.where(easy, longer, history.increment))
    inverted = jnp.where(failed, step.inverting, history.inverted)
    failure = jnp.where(inverted, Status.INVERTED_ELEMENT, Status.LOAD_LIMIT)
    failure = jnp.where(history.singular, Status.SINGULAR_TANGENT, failure)
    status = jnp.where(iterations >= options.max_iterations, Status.ITERATION_LIMIT, Status.RUNNING)
    status = jnp.where(failed & (increment < options.min_increment), failure, status)
    status = jnp.where(complete, Status.CONVERGED, status)
    next_load = jnp.minimum(1.0, load_reached + increment)
    good = whole & jnp.isfinite(after) & (after <= options.keep_tangent * before)
    return state._replace(
        u=jnp.where(failed, u_reached, step.u),
        load=jnp.where(level_ends & ~complete, next_load, state.load),
        residual=step.residual,
        relative_residual=jnp.where(round_off, 0.0, after),
        renew=level_ends | ~(good & state.displacement_only),
        iterations=iterations,
        factorisations=state.factorisations + state.renew,
        history=history._replace(
            u=u_reached,
            load=load_reached,
            increment=increment,
            iterations=jnp.where(level_ends, 0, level_iterations),
            monotone=(level_ends & ~complete) | monotone,
            inversions=jnp.where(level_ends, 0, inversions),
            inverted=inverted,
        ),
        status=jnp.asarray(status, dtype=state.status.dtype),
    )
