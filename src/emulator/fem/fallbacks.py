r"""The search for equilibrium: a list of strategies, each the fallback of the one before.

A body with several equilibria has one that loading leads to from rest. These strategies look for it
(:func:`strategies`):

1. From the caller's start, at the full load: stress iterates while the relative residual exceeds
   5 %, then Newton's method.
2. From rest, stress iterates (:mod:`emulator.fem.stress_iterates`) up a schedule of
   load factors, then Newton's method from where they lead. There are four schedules, of ever
   smaller increments.
3. From rest, Newton's method, load level by load level (:mod:`emulator.fem.load_stepping`).

A scene whose stresses cannot be unknowns has the first and the last. Every strategy but the last
has to be short and monotone: Newton's method takes only a few steps, each a full one, down the
potential, with a positive definite tangent. Otherwise the next strategy begins.

:class:`EquilibriumSearch` has the steps as pure functions of one state, and
:func:`find_equilibrium` is the one loop over them: Python's where theta is numbers, ``jax.lax``'s
inside ``jit`` (:mod:`emulator.fem.compiled`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.assembly import System
from emulator.fem.compiled import cond, while_loop
from emulator.fem.formulations.displacement import UNBALANCED
from emulator.fem.load_stepping import LoadStepping
from emulator.fem.newton import NEAR, NewtonOptions
from emulator.fem.solution import NewtonState, Solution, Status
from emulator.fem.stress_iterates import StressIterates, StressState, applies


class Strategy(NamedTuple):
    """A strategy, as numbers that one compiled loop reads.

    first_load : the first load factor of the stress iterates.
    load_increment : the load increment of the stress iterates.
    most_steps : the largest number of stress iterates.
    steep : whether its loads rise fast. A steep schedule's next increment is twice as long after
        an easy step, and a second indefinite tangent in a row ends it; the others recover.
    newton_load : the first load factor and increment of Newton's method.
    largest_indefinite : the largest load increment that Newton's method still tries after an
        indefinite tangent.
    """

    first_load: float = 1.0
    load_increment: float = 0.0
    most_steps: int = 0
    steep: bool = True
    newton_load: float = 1.0
    largest_indefinite: float = np.inf


FROM_START = Strategy(most_steps=8)
"""For a start that is better balanced than rest."""
# The first schedule takes ventricles from rest to all but their softest corners, in four to six
# steps: with the full load at once one in three diverges. The last is for beams that turn.
# (docs/experiments.md, "Stresses as iterates")
SCHEDULES = (
    Strategy(0.5, 0.25, 12),
    Strategy(0.25, 0.125, 20),
    Strategy(0.05, 0.05, 80, steep=False),
    Strategy(0.02, 0.02, 160, steep=False),
)
"""Stress iterates from rest, then Newton's method at the full load."""
# docs/experiments.md, "Several equilibria in the soft corner".
LOAD_LEVELS = Strategy(newton_load=0.1, largest_indefinite=1.0 / 40.0)
"""Newton's method from rest, where all schedules have failed."""

# Load stepping solves what the later schedules do not, where supports move
# (docs/experiments.md, "Ramps for supports that move").
_SCHEDULES_OF_MOVING_SUPPORTS = 2
# Relative residual below which the load of a schedule rises (docs/experiments.md, "Stresses as
# iterates").
_BALANCED = 0.9
_MOST_AT_LEVEL = 12  # steps at one load factor; schedules that need more do not converge
# Relative residual after an easy step, and indefinite tangents in a row that end a steep schedule
# (docs/experiments.md, "Ramps: sooner lost, sooner up").
_EASY = 0.3
_TOO_STEEP = 2
# Relative residual up to which a start is used; at rest it is about 1 (docs/experiments.md,
# "Rough starts").
_FARTHEST = 0.9
_SHORT = 15  # largest number of Newton iterations, except in the last strategy


def strategies(system: System, options: NewtonOptions) -> tuple[Strategy, ...]:
    """Return the strategies for a scene, in the order in which they are tried."""
    if not options.stress_iterates or options.increment != 1.0 or not applies(system.scene):
        return FROM_START, Strategy(newton_load=options.increment)
    moving = system.scene.prescribed.moves
    schedules = SCHEDULES[:_SCHEDULES_OF_MOVING_SUPPORTS] if moving else SCHEDULES
    return FROM_START, *schedules, LOAD_LEVELS


class SearchState(NamedTuple):
    """The state of the search for equilibrium.

    newton : the state of Newton's method; its status and its iterations are also the search's.
    stress : the state of the stress iterates, or None where the scene has none.
    strategy : the index of the strategy.
    begins : whether the next step begins the strategy, or its Newton's method, at ``newton.u``.
    by_stress : whether the next step is of the stress iterates.
    load : the load factor of the stress iterates.
    steps : the steps that the stress iterates have taken in this strategy.
    level_steps : the steps of the stress iterates at this load factor.
    """

    newton: NewtonState
    stress: StressState | None
    strategy: jax.Array
    begins: jax.Array
    by_stress: jax.Array
    load: jax.Array
    steps: jax.Array
    level_steps: jax.Array

    @property
    def running(self) -> jax.Array:
        """Whether the search has not ended."""
        return self.newton.running | self.begins


@dataclass(frozen=True, eq=False)
class EquilibriumSearch:
    """The steps of all strategies at one theta.

    system : the equations.
    options : the controls of the solver.
    theta : the parameters (p,).
    """

    system: System
    options: NewtonOptions
    theta: jax.Array

    @cached_property
    def strategies(self) -> tuple[Strategy, ...]:
        """The strategies in the order in which they are tried."""
        return strategies(self.system, self.options)

    @property
    def _has_schedules(self) -> bool:
        return len(self.strategies) > 2

    @property
    def load_stepping(self) -> LoadStepping:
        """Newton's method at rising load factors."""
        return LoadStepping(self.system, self.options, self.theta)

    def _stress_iterates(self, load: jax.Array) -> StressIterates:
        return StressIterates(self.system, self.options.shrink, self.theta, load)

    def begin(self, newton: NewtonState) -> SearchState:
        """Return the first state, from Newton's at the caller's start: there or at rest."""
        # Load increments of the caller's choice are followed from rest.
        usable = jnp.any(newton.u != 0.0) & (self.options.increment == 1.0)
        stress = None
        if self._has_schedules:
            usable &= newton.relative_residual <= _FARTHEST
            stress = self._stress_iterates(jnp.ones(())).begin(newton.u)
        begins = ~usable & newton.running
        far = newton.relative_residual > NEAR
        count = jnp.zeros((), dtype=int)
        return SearchState(
            newton=newton._replace(u=jnp.where(begins, 0.0, newton.u)),
            stress=stress,
            strategy=jnp.where(usable, np.int64(0), np.int64(1)),
            begins=begins,
            by_stress=(begins | far) & newton.running & self._has_schedules,
            load=jnp.ones(()),
            steps=count,
            level_steps=count,
        )

    def step(self, state: SearchState) -> SearchState:
        """Return the state after the beginning of a strategy, or after its next step."""

        def proceed(state: SearchState) -> SearchState:
            if not self._has_schedules:
                return self._newton_step(state)
            return cond(state.by_stress, self._stress_step, self._newton_step, state)

        return cond(state.begins, self._begin_strategy, proceed, state)

    def _begin_strategy(self, state: SearchState) -> SearchState:
        """Return the state at the beginning of its strategy; iterations are counted on."""
        before, strategy, stress = state.newton, _strategy(self.strategies, state.strategy), None
        newton = self.load_stepping.begin(before.u, before.round_off)
        if self._has_schedules:
            stress = self._stress_iterates(strategy.first_load).begin(before.u)
        history = newton.history._replace(
            increment=strategy.newton_load, largest_indefinite=strategy.largest_indefinite
        )
        by_stress = state.by_stress & newton.running & (strategy.most_steps > 0)
        return state._replace(
            newton=newton._replace(
                load=strategy.newton_load,
                history=history,
                iterations=before.iterations,
                factorisations=before.factorisations,
            ),
            stress=stress,
            begins=jnp.array(False),
            by_stress=by_stress & self._has_schedules,
            load=strategy.first_load,
            steps=jnp.zeros((), dtype=int),
            level_steps=jnp.zeros((), dtype=int),
        )

    def _stress_step(self, state: SearchState) -> SearchState:
        """Return the state after one step of the stress iterates."""
        assert state.stress is not None
        # No loads are balanced in the first step from rest, and a start far from balance has rough
        # stresses: either stiffness would make the tangent indefinite.
        unbalanced = state.newton.relative_residual > UNBALANCED
        first = (state.steps == 0) & ((state.strategy != 0) | unbalanced)
        factors = jnp.where(first, 0.0, state.load), jnp.where(first, 0.0, 1.0)
        # Strategy 0 ends at an indefinite tangent; later ones solve again without extra stiffness.
        iterates = self._stress_iterates(state.load)
        stress = iterates.step(state.stress, *factors, state.strategy != 0)
        most = self.options.max_iterations
        return _after_stress_step(state, stress, table=self.strategies, most=most)

    def _newton_step(self, state: SearchState) -> SearchState:
        """Return the state after one iteration of Newton's method."""
        last = len(self.strategies) - 1
        newton = self.load_stepping.step(state.newton, state.strategy == last)
        return _after_newton_step(state, newton, last=last, schedules=self._has_schedules)


def _strategy(table: tuple[Strategy, ...], number: jax.Array) -> Any:
    """Return one strategy, its numbers as arrays ()."""
    return Strategy._make(jnp.array(column)[number] for column in zip(*table, strict=True))


@partial(jax.jit, static_argnames=("table", "most"))
def _after_stress_step(
    state: SearchState, stress: StressState, *, table: tuple[Strategy, ...], most: int
) -> SearchState:
    """Return the state after a step of the stress iterates: next load, Newton, or fallback."""
    newton, strategy = state.newton, _strategy(table, state.strategy)
    valid = (stress.fraction > 0.0) & jnp.isfinite(stress.error) & stress.definite
    valid &= (stress.refused < _TOO_STEEP) | ~strategy.steep
    balanced = valid & (state.load == 1.0) & (stress.error <= NEAR)
    exhausted = (state.steps + 1 >= strategy.most_steps) | (state.level_steps + 1 >= _MOST_AT_LEVEL)
    failed = ~valid | (~balanced & exhausted)
    ends = failed | balanced
    easy = (stress.error < _EASY) & (state.steps > 1) & strategy.steep
    higher = state.load + jnp.where(easy, 2.0, 1.0) * strategy.load_increment
    load = jnp.where(stress.error < _BALANCED, jnp.minimum(1.0, higher), state.load)
    iterations = newton.iterations + 1
    too_many = iterations >= most
    return state._replace(
        newton=newton._replace(
            u=jnp.where(ends, jnp.where(failed, 0.0, stress.u), newton.u),
            iterations=iterations,
            factorisations=newton.factorisations + 1,
            status=jnp.where(too_many, Status.ITERATION_LIMIT, newton.status),
        ),
        stress=stress,
        strategy=jnp.where(ends & failed, state.strategy + 1, state.strategy),
        begins=ends & ~too_many,
        by_stress=jnp.where(ends, failed, state.by_stress),
        load=load,
        steps=state.steps + 1,
        level_steps=jnp.where(load > state.load, 0, state.level_steps + 1),
    )


@partial(jax.jit, static_argnames=("last", "schedules"))
def _after_newton_step(
    state: SearchState, newton: NewtonState, *, last: int, schedules: bool
) -> SearchState:
    """Return the state, or the beginning of the next strategy where Newton's method has failed.

    It has, where it is not short and monotone at the full load: a level that failed is followed by
    a lower one.
    """
    running, history = newton.running, newton.history
    ended = (newton.status == Status.CONVERGED) | (newton.status == Status.ITERATION_LIMIT)
    failed = (~running & ~ended) | ~history.monotone | (newton.load < 1.0)
    fails = (failed | (running & (history.iterations >= _SHORT))) & (state.strategy < last)
    return state._replace(
        newton=newton._replace(u=jnp.where(fails, 0.0, newton.u)),
        strategy=jnp.where(fails, state.strategy + 1, state.strategy),
        begins=fails,
        by_stress=fails & schedules,
    )


def find_equilibrium(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """Solve the equations of ``system`` at ``theta`` (p,), from ``start`` (n, 3) mm.

    The status of the solution is CONVERGED or names the failure; its displacement is always finite.
    """
    search = EquilibriumSearch(system, options, theta)
    first = search.begin(search.load_stepping.begin(start))
    return while_loop(lambda state: state.running, search.step, first).newton.solution()
