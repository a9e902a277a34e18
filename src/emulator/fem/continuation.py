r"""The way to equilibrium: which routes are tried, in which order, and when one is given up.

A body with several equilibria has one that loading leads to from rest. These routes look for it:

======  ==================================================================================
WARM    from the caller's start, at the whole load: stress iterates while the residual is
        above 5 %, then Newton's method
RAMPS   stress iterates (:mod:`emulator.fem.formulations.stress_iterates`) from rest up a ramp of
        loads, four ramps of ever smaller increments, and Newton's method from where one leads
CLIMB   Newton's method from rest, load step by load step
======  ==================================================================================

Every route but the last has to be short and convex: Newton's method takes full steps only, each
down the potential with a positive definite tangent, and no more than a few.
Otherwise the next route is tried, from rest. Scenes whose stresses cannot be iterates have no
ramps.

:class:`LoadingPath` has the steps of all routes as pure functions of one state, and
:func:`find_equilibrium` is the one loop over them: Python's where theta is numbers, ``jax.lax``'s
inside ``jit`` (:mod:`emulator.fem.loop`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.formulations.stress_iterates import StressIterates, StressState, applies
from emulator.fem.loop import cond, while_loop
from emulator.fem.newton import Newton
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution, Status
from emulator.fem.state import NEAR, UNBALANCED, NewtonState
from emulator.fem.system import System


class Route(IntEnum):
    """Ways to equilibrium, in the order in which they are tried."""

    WARM = 0
    RAMP = 1  # the first of four
    CLIMB = 5


class _Ramp(NamedTuple):
    """Load levels that stress iterates climb, a step or more on each."""

    first: float
    increment: float
    steps: int


# By route. The first is for a start that is better balanced than rest. The second takes
# ventricles from rest to all but their softest corners, in four to six steps: with the whole load
# at once one in three is lost. The last is for beams that turn. (docs/experiments.md, "Stresses as
# iterates")
_RAMPS = (
    _Ramp(1.0, 0.0, 8),
    _Ramp(0.5, 0.25, 12),
    _Ramp(0.25, 0.125, 20),
    _Ramp(0.05, 0.05, 80),
    _Ramp(0.02, 0.02, 160),
)
# Ramps of a body whose supports are moved: climbing finds what these do not
# (docs/experiments.md, "Ramps for supports that move").
_PULLED = 2
# Relative residual below which a level of a ramp is carried well enough to go up
# (docs/experiments.md, "Stresses as iterates").
_CARRIED = 0.9
_MOST_AT_LEVEL = 12  # steps at a level of a ramp; where more are needed, none will do
# The first two ramps are the steep ones: a relative residual after a step below which their next
# increment is twice as long, and indefinite tangents in a row that show them to be too steep. The
# others get over theirs (docs/experiments.md, "Ramps: sooner lost, sooner up").
_GENTLE = Route.RAMP + 2
_EASILY = 0.3
_TOO_STEEP = 2
# Relative residual up to which a start is begun from; that of rest is about 1 (docs/experiments.md,
# "Rough starts").
_FARTHEST = 0.9
# First level and largest increment of the climb where all ramps are lost (docs/experiments.md,
# "Several equilibria in the soft corner").
_TENTH = np.float64(0.1)
_FIRST_LEVELS = np.array([*(ramp.first for ramp in _RAMPS), _TENTH])  # by route
# Load increment below which the climb takes steps that are not convex.
_CAREFUL = np.float64(1.0 / 40.0)
_SHORT = 15  # iterations of Newton's method that a route may take, unless it is the last


class PathState(NamedTuple):
    """Where the search for equilibrium stands.

    newton : the iteration of Newton's method; its status is that of the search.
    mip : the stress iterates, or None where the scene has no ramps.
    route : a :class:`Route`. ramping : whether stress iterates are on their way up its ramp.
    level : load level on the ramp. on_ramp : steps taken there, at_level : of them at this level.
    ramped : steps on all ramps.
    entering : whether the route is yet to be begun, at ``newton.u``, on its ramp if ``ramping``.
    """

    newton: NewtonState
    mip: StressState | None
    route: jax.Array
    ramping: jax.Array
    level: jax.Array
    on_ramp: jax.Array
    at_level: jax.Array
    ramped: jax.Array
    entering: jax.Array

    @property
    def running(self) -> jax.Array:
        """Whether the search has not ended."""
        return self.newton.running | self.entering


@dataclass(frozen=True, eq=False)
class LoadingPath:
    """The steps of all routes, for one theta."""

    system: System
    options: NewtonOptions
    theta: jax.Array

    @cached_property
    def ramps(self) -> bool:
        """Whether stresses can be iterates, up ramps that begin at rest."""
        wanted = self.options.stress_iterates and self.options.increment == 1.0
        return wanted and applies(self.system.scene)

    @property
    def _last_ramp(self) -> int:
        """Route of the last ramp that is tried; none where there are no ramps."""
        pulled = self.system.scene.prescribed.moves
        return (_PULLED if pulled else Route.CLIMB - 1) if self.ramps else 0

    @property
    def _newton(self) -> Newton:
        return Newton(self.system, self.options, self.theta)

    def _mip(self, level: jax.Array) -> StressIterates:
        return StressIterates(self.system, self.options.shrink, self.theta, level)

    def begin(self, start: jax.Array) -> PathState:
        """The state to search from, at ``start`` (n, 3) mm."""
        newton = self._newton.begin(start)
        # A load increment of the caller's choice is meant to be followed from rest.
        warm = _warm(newton, ramps=self.ramps) & (self.options.increment == 1.0)
        cold = np.int64(Route.RAMP if self.ramps else Route.CLIMB)
        mip = self._mip(jnp.ones(())).begin(newton.u) if self.ramps else None
        entering = ~warm & newton.running
        return PathState(
            newton=newton._replace(u=jnp.where(entering, 0.0, newton.u)),
            mip=mip,
            route=jnp.where(warm, np.int64(Route.WARM), cold),
            ramping=(entering | (newton.error > NEAR)) & newton.running & self.ramps,
            level=jnp.ones(()),
            on_ramp=jnp.zeros((), dtype=int),
            at_level=jnp.zeros((), dtype=int),
            ramped=jnp.zeros((), dtype=int),
            entering=entering,
        )

    def step(self, state: PathState) -> PathState:
        """A route's beginning, or its next step."""

        def onwards(state: PathState) -> PathState:
            if not self.ramps:
                return self.newton_step(state)
            return cond(state.ramping, self.ramp_step, self.newton_step, state)

        return cond(state.entering, self._enter, onwards, state)

    def ramp_step(self, state: PathState) -> PathState:
        """One step of the stress iterates."""
        assert state.mip is not None
        stiffening, geometric = _stiffnesses(
            state.level, state.route, state.on_ramp, state.newton.error
        )
        # A start whose tangent is indefinite is left for rest.
        again = state.route != Route.WARM
        mip = self._mip(state.level).step(state.mip, stiffening, geometric, again)
        return _after_ramp_step(state, mip, last=self._last_ramp)

    def newton_step(self, state: PathState) -> PathState:
        """One iteration of Newton's method."""
        any_tangent = state.route == Route.CLIMB
        after = state._replace(newton=self._newton.step(state.newton, any_tangent))
        return _after_newton_step(after, last=self._last_ramp)

    def _enter(self, state: PathState) -> PathState:
        """The state at the beginning of its route; iterations are counted on."""
        before, level, mip = state.newton, jnp.ones(()), None
        newton = self._newton.begin(before.u, before.negligible)
        if self.ramps:
            level = _first_level(state.route)
            mip = self._mip(level).begin(before.u)
        newton = newton._replace(iterations=before.iterations, factorisations=before.factorisations)
        return _entered(newton, mip, state.route, state.ramping, level, state.ramped)


@partial(jax.jit, static_argnames="ramps")
def _warm(newton: NewtonState, *, ramps: bool) -> jax.Array:
    """Whether Newton's method is worth trying from where it begins."""
    moved = jnp.any(newton.u != 0.0)
    return moved & (newton.error <= _FARTHEST) if ramps else moved


@jax.jit
def _first_level(route: jax.Array) -> jax.Array:
    return jnp.asarray(_FIRST_LEVELS)[route]


@jax.jit
def _stiffnesses(
    level: jax.Array, route: jax.Array, on_ramp: jax.Array, error: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Load level whose stiffness a ramp's step reads, and how much of the stresses'.

    Loads that nothing balances yet lend none, as in Newton's method; nor do the stresses of a start
    that are not in balance: rough ones would make the tangent indefinite.
    """
    first = (on_ramp == 0) & ((route != Route.WARM) | (error > UNBALANCED))
    return jnp.where(first, 0.0, level), jnp.where(first, 0.0, 1.0)


def _judged(state: PathState, mip: StressState) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Next level of a ramp after a step; whether the ramp is lost, and whether it is left."""
    _, increment, steps = jnp.array(_RAMPS)[state.route]
    sound = (mip.fraction > 0.0) & jnp.isfinite(mip.error) & mip.definite
    gentle = state.route >= _GENTLE
    sound &= (mip.refused < _TOO_STEEP) | gentle
    found = sound & (state.level == 1.0) & (mip.error <= NEAR)
    spent = (state.on_ramp + 1 >= steps) | (state.at_level + 1 >= _MOST_AT_LEVEL)
    easy = (mip.error < _EASILY) & (state.on_ramp > 1) & ~gentle
    higher = jnp.minimum(1.0, state.level + jnp.where(easy, 2.0, 1.0) * increment)
    level = jnp.where(mip.error < _CARRIED, higher, state.level)
    lost = ~sound | (~found & spent)
    return level, lost, lost | found


def _following(route: jax.Array, last: int) -> jax.Array:
    """The route after one that led nowhere; ``last`` is that of the last ramp."""
    return jnp.where(route >= last, jnp.full_like(route, Route.CLIMB), route + 1)


@partial(jax.jit, static_argnames="last")
def _after_ramp_step(state: PathState, mip: StressState, *, last: int) -> PathState:
    """The state after a step of the stress iterates."""
    level, lost, leaves = _judged(state, mip)
    newton = state.newton
    return state._replace(
        newton=newton._replace(u=jnp.where(leaves, jnp.where(lost, 0.0, mip.u), newton.u)),
        mip=mip,
        route=jnp.where(leaves & lost, _following(state.route, last), state.route),
        ramping=jnp.where(leaves, lost, state.ramping),
        level=level,
        on_ramp=state.on_ramp + 1,
        ramped=state.ramped + 1,
        at_level=jnp.where(level > state.level, 0, state.at_level + 1),
        entering=leaves,
    )


@partial(jax.jit, static_argnames="last")
def _after_newton_step(state: PathState, *, last: int) -> PathState:
    """The state, or the beginning of the next route where another has to be tried."""
    newton = state.newton
    astray = _astray(newton.status, newton.convex, newton.level, newton.at_level, state.route)
    return state._replace(
        newton=newton._replace(u=jnp.where(astray, 0.0, newton.u)),
        route=jnp.where(astray, _following(state.route, last), state.route),
        ramping=astray & (last > 0),
        entering=astray,
    )


@jax.jit
def _astray(
    status: jax.Array, convex: jax.Array, level: jax.Array, at_level: jax.Array, route: jax.Array
) -> jax.Array:
    """Whether Newton's method shows that another route has to be tried."""
    running = status == Status.RUNNING
    ended = (status == Status.CONVERGED) | (status == Status.ITERATION_LIMIT)
    # A level that failed is followed by a lower one.
    astray = (~running & ~ended) | ~convex | (level < 1.0) | (running & (at_level >= _SHORT))
    return astray & (route < Route.CLIMB)


@jax.jit
def _entered(
    newton: NewtonState,
    mip: StressState | None,
    route: jax.Array,
    ramping: jax.Array | bool,
    level: jax.Array,
    ramped: jax.Array,
) -> PathState:
    """The state on ``route``, Newton's method and stress iterates begun."""
    ramps = mip is not None
    if ramps:
        climb = route == Route.CLIMB
        level_of_newton = jnp.where(climb, _TENTH, 1.0)
        newton = newton._replace(
            level=level_of_newton,
            increment=level_of_newton,
            careful=jnp.where(climb, _CAREFUL, jnp.inf),
        )
    return PathState(
        newton=newton,
        mip=mip,
        route=route,
        ramping=ramping & newton.running & (route < Route.CLIMB) & ramps,
        level=level,
        on_ramp=jnp.zeros((), dtype=int),
        at_level=jnp.zeros((), dtype=int),
        ramped=ramped,
        entering=jnp.array(False),
    )


def find_equilibrium(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """Minimise the potential energy of ``system``.

    Parameters
    ----------
    theta : (p,) parameters.
    start : (n, 3) mm, where to start.

    Returns
    -------
    Solution, whose status is CONVERGED or names the failure; its displacement is always finite.
    """
    path = LoadingPath(system, options, theta)
    state = while_loop(lambda state: state.running, path.step, path.begin(start))
    found = state.newton.solution()
    return found._replace(
        iterations=found.iterations + state.ramped,
        factorisations=found.factorisations + state.ramped,
    )
