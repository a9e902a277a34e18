r"""The way to equilibrium: which routes are tried, in which order, and when one is given up.

A body with several equilibria has one that loading leads to from rest. These routes look for it:

======  ==================================================================================
WARM    from the caller's start, at the whole load: stress iterates while the residual is
        above 5 %, then Newton's method
RAMPS   stress iterates (:mod:`emulator.fem.mip`) from rest up a ramp of loads, three ramps
        of ever smaller increments, and Newton's method from where a ramp leads
CLIMB   Newton's method from rest, load step by load step
======  ==================================================================================

Every route but the last has to be short and convex: Newton's method takes full steps only, each
down the potential with, as far as is known, a positive definite tangent, and no more than a few.
Otherwise the next route is tried, from rest. Scenes whose stresses cannot be iterates have no
ramps.

:class:`LoadingPath` has the steps of all routes as pure functions of one state. One strategy then
runs in two ways: inside ``jit`` (:func:`find_equilibrium`) and driven from Python
(:mod:`emulator.fem.driver`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.assembly import System
from emulator.fem.mip import MipNewton, MipState, applies
from emulator.fem.newton import Newton
from emulator.fem.options import NewtonOptions
from emulator.fem.programs import cond
from emulator.fem.solution import Solution, Status
from emulator.fem.state import NEAR, UNBALANCED, NewtonState


class Route(IntEnum):
    """Ways to equilibrium, in the order in which they are tried."""

    WARM = 0
    RAMP = 1  # the first of three
    CLIMB = 4


class _Ramp(NamedTuple):
    """Load levels that stress iterates climb, a step or more on each."""

    first: float
    increment: float
    steps: int


# By route. The first is for a start that is better balanced than rest. The second takes
# ventricles from rest to all but their softest corners, in four to six steps: with the whole load
# at once one in three is lost. The last is for beams that turn. (docs/experiments.md, "Stresses as
# iterates")
_RAMPS = (_Ramp(1.0, 0.0, 8), _Ramp(0.5, 0.25, 12), _Ramp(0.25, 0.125, 20), _Ramp(0.1, 0.1, 40))
# Relative residual below which a level of a ramp is carried well enough to go up
# (docs/experiments.md, "Stresses as iterates").
_CARRIED = 0.9
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

    newton : the iteration of Newton's method; its status and its counts are those of the search.
    mip : the stress iterates, or None where the scene has no ramps.
    route : a :class:`Route`. ramping : whether stress iterates are on their way up its ramp.
    level : load level on the ramp. on_ramp : steps taken there.
    """

    newton: NewtonState
    mip: MipState | None
    route: jax.Array
    ramping: jax.Array
    level: jax.Array
    on_ramp: jax.Array

    @property
    def running(self) -> jax.Array:
        """Whether the search has not ended."""
        return self.newton.running


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
        return wanted and applies(self.system) and not self.system.scene.held_displacement.any()

    @property
    def _newton(self) -> Newton:
        return Newton(self.system, self.options, self.theta)

    def _mip(self, level: jax.Array) -> MipNewton:
        return MipNewton(self.system, self.options.shrink, self.theta, level)

    def begin(self, start: jax.Array) -> PathState:
        """The state to search from, at ``start`` (n, 3) mm."""
        newton = self._newton.begin(start)
        # A load increment of the caller's choice is meant to be followed from rest.
        warm = _warm(newton, ramps=self.ramps) & (self.options.increment == 1.0)
        cold = np.int64(Route.RAMP if self.ramps else Route.CLIMB)
        route = jnp.where(warm, Route.WARM, cold)

        def stay() -> PathState:
            mip = self._mip(jnp.ones(())).begin(newton.u) if self.ramps else None
            ramping = (newton.error > NEAR) & self.ramps
            count = jnp.zeros((), dtype=int)
            return PathState(newton, mip, route, ramping, jnp.ones(()), count)

        rest = jnp.zeros_like(start)
        return cond(warm | ~newton.running, stay, lambda: self._enter(newton, rest, route, True))

    def ramp_step(self, state: PathState) -> PathState:
        """One step of the stress iterates."""
        assert state.mip is not None
        stiffening, geometric = _stiffnesses(
            state.level, state.route, state.on_ramp, state.newton.error
        )
        mip = self._mip(state.level).step(state.mip, stiffening, geometric)
        level, lost, leaves = _judged(
            state.level, state.route, state.on_ramp, mip.error, mip.fraction, mip.definite
        )
        newton = state.newton
        newton = newton._replace(
            iterations=newton.iterations + 1, factorisations=newton.factorisations + 1
        )
        newton = newton._replace(status=_limited(newton, self.options.max_iterations))
        after = state._replace(newton=newton, mip=mip, level=level, on_ramp=state.on_ramp + 1)

        def enter() -> PathState:
            u = jnp.where(lost, 0.0, mip.u)
            return self._enter(newton, u, jnp.where(lost, state.route + 1, state.route), lost)

        return cond(leaves & newton.running, enter, lambda: after)

    def newton_step(self, state: PathState) -> PathState:
        """One iteration of Newton's method."""
        after = state._replace(newton=self._newton.step(state.newton))
        newton = after.newton
        astray = _astray(newton.status, newton.convex, newton.level, newton.at_level, after.route)
        return cond(astray, self.give_up, lambda state: state, after)

    def give_up(self, state: PathState) -> PathState:
        """The state at the beginning of the next route."""
        rest = jnp.zeros_like(state.newton.u)
        return self._enter(state.newton, rest, self._next(state.route), True)

    def _next(self, route: jax.Array) -> jax.Array:
        return route + 1 if self.ramps else jnp.full_like(route, Route.CLIMB)

    def _enter(
        self, before: NewtonState, u: jax.Array, route: jax.Array, ramping: jax.Array | bool
    ) -> PathState:
        """The state at ``u`` (n, 3) mm on ``route``, at the foot of its ramp if ``ramping``.

        Iterations are counted on.
        """
        newton, level, mip = self._newton.begin(u, before.negligible), jnp.ones(()), None
        if self.ramps:
            level = _first_level(route)
            mip = self._mip(level).begin(u)
        newton = newton._replace(iterations=before.iterations, factorisations=before.factorisations)
        return _entered(newton, mip, route, ramping, level)


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


@jax.jit
def _judged(
    level: jax.Array,
    route: jax.Array,
    on_ramp: jax.Array,
    error: jax.Array,
    fraction: jax.Array,
    definite: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Next level of a ramp after a step; whether the ramp is lost, and whether it is left."""
    _, increment, steps = jnp.array(_RAMPS)[route]
    sound = (fraction > 0.0) & jnp.isfinite(error) & definite
    found = sound & (level == 1.0) & (error <= NEAR)
    lost = ~sound | (~found & (on_ramp + 1 >= steps))
    higher = jnp.minimum(1.0, level + increment)
    return jnp.where(error < _CARRIED, higher, level), lost, lost | found


def _limited(newton: NewtonState, most: int) -> jax.Array:
    """Status where ``most`` iterations are allowed."""
    return jnp.where(newton.iterations >= most, np.int64(Status.ITERATION_LIMIT), newton.status)


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
    mip: MipState | None,
    route: jax.Array,
    ramping: jax.Array | bool,
    level: jax.Array,
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
    )


def find_equilibrium(
    system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array
) -> Solution:
    """Minimise the potential energy of ``system``, as one loop inside ``jax.jit``.

    Parameters
    ----------
    theta : (p,) parameters.
    start : (n, 3) mm, where to start.

    Returns
    -------
    Solution, whose status is CONVERGED or names the failure; its displacement is always finite.
    """
    path = LoadingPath(system, options, theta)
    step: Callable[[PathState], PathState] = path.newton_step
    if path.ramps:
        step = lambda state: jax.lax.cond(  # noqa: E731
            state.ramping, path.ramp_step, path.newton_step, state
        )
    state = jax.lax.while_loop(lambda state: state.running, step, path.begin(start))
    return state.newton.solution()
