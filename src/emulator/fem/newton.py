r"""Newton's method with adaptive load steps, as one loop inside ``jax.jit``.

At load level :math:`s \in (0, 1]` the dead loads are :math:`s f` and the held displacements
:math:`s \bar u`. Each iteration solves

.. math::
    K(u)\, \Delta u = -\left[r_s(u) + K(u)\, \Delta \bar u\right], \qquad
    \Delta \bar u = s \bar u - u|_\text{held}

and steps by the largest :math:`\alpha \in \{1, \tfrac12, \tfrac14, \dots\}` that keeps every
element's :math:`J` above a fraction of its present least value and, once the supports are met,
lowers the potential energy (Armijo's rule; where the tangent is indefinite and Newton's direction
climbs, the opposite one is taken). Exponential laws diverge without it. Loads without a potential
are held at their present force for this rule, and a step that lowers the residual instead will do.
A level that does not converge, or only crawls, is tried again with half the load increment.

With mean dilatation the elements' volumes and pressures are iterates of their own (see
:mod:`emulator.fem.mixed`). The point sought is then a saddle, and no energy tells a good step from
a bad one. Deuflhard's natural monotonicity does: from where a step leads, Newton with the tangent
of where it started must have less far to go,

.. math::
    \left| K(x)^{-1} r(x + \alpha \Delta x) \right|
    \le \left(1 - \frac{\alpha}{4}\right) |\Delta x|

(P. Deuflhard, Newton Methods for Nonlinear Problems, 2004, ch. 3.3). The factors are there
already. Measured in mm, the stiff volumes do not drown all else as they do in a residual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System, balance
from emulator.fem.mixed import Condensed, Volumes, advance, carried, consistent, linearise
from emulator.fem.solution import Solution, Status
from emulator.mechanics.energy import volume_ratio

_LEAST_FRACTION = 2.0**-20
_LEAST_MIXED_FRACTION = 2.0**-7  # natural monotonicity fails early: a lower load is cheaper
# Steps shorter than this are a crawl, as are those kept short by elements about to be crushed.
# After so many a level is given up for a lower one.
_CRAWL, _CRAWLS = 2.0**-6, 8
# A step that is this much longer than the force over the largest stiffness: a singular tangent.
_ENDLESS = 1e13
_ARMIJO = 1e-4
_ROUND_OFF = 1e-13


@dataclass(frozen=True)
class NewtonOptions:
    """Controls of the solver.

    tolerance : residual relative to the internal forces, reactions included.
    round_off : a residual below this that Newton no longer reduces has met round-off, and will do.
    absolute : residual in mN that is small enough whatever the forces; 0 asks for the others.
    max_iterations : over all load levels.
    level_iterations : after which a load level is given up and its increment halved.
    min_increment : smallest load increment, as a fraction of the whole.
    shrink : least fraction of the present smallest ``J`` that a step may leave.
    """

    tolerance: float = 1e-11
    round_off: float = 1e-8
    absolute: float = 0.0
    max_iterations: int = 200
    level_iterations: int = 40
    min_increment: float = 1.0 / 256.0
    shrink: float = 0.2


class _Step(NamedTuple):
    """Newton's full step, and what judges how much of it to take."""

    move: jax.Array  # (n, 3)
    residual: jax.Array  # (f,)
    slope: jax.Array  # residual . move, before it was turned round
    settled: jax.Array  # whether the supports are where they belong
    solvable: jax.Array
    condensed: Condensed | None
    values: jax.Array  # (nnz,) of the tangent
    pull: jax.Array  # (f,) change of the residual with the held displacement


class _State(NamedTuple):
    u: jax.Array  # (n, 3) current iterate
    volumes: Volumes | None  # that go with it, for mean dilatation
    level: jax.Array  # load level being solved
    u_reached: jax.Array  # (n, 3) solution at the last level that converged
    reached: jax.Array  # that level
    increment: jax.Array
    at_level: jax.Array  # iterations spent at this level
    iterations: jax.Array
    error: jax.Array  # residual relative to the tolerance's scale at `u`, of level `level`
    status: jax.Array
    obstacle: jax.Array  # the status to end with, should this be the last step
    crawled: jax.Array  # short steps at this level


def newton(system: System, options: NewtonOptions, theta: jax.Array, start: jax.Array) -> Solution:
    """Minimise the potential energy of ``system``.

    Parameters
    ----------
    theta : (p,) parameters.
    start : (n, 3) mm, where to start; its held entries need not fit the supports yet.

    Returns
    -------
    Solution, whose status is CONVERGED or names the failure; its displacement is always finite.
    """
    held = jnp.asarray(system.scene.held)
    held_values = jnp.asarray(system.scene.held_displacement)

    least = _LEAST_MIXED_FRACTION if system.mixed else _LEAST_FRACTION

    def balanced(u: jax.Array, level: jax.Array) -> tuple[jax.Array, jax.Array]:
        return balance(system, u, theta, level, options.absolute)

    def volumes_of(u: jax.Array) -> Volumes | None:
        return consistent(system.scene, u, theta) if system.mixed else None

    def step(state: _State) -> _State:
        move_held = jnp.where(held, state.level * held_values - state.u, 0.0)
        step = _full_step(system, state, theta, move_held)
        crushes = _guard(system, state, step, options.shrink)
        accepts = _acceptance(system, options, state, theta, step)
        fraction, crushed = _largest_fraction(crushes, accepts, least)
        admissible = step.solvable & (fraction > 0.0)
        u = jnp.where(admissible, state.u + fraction * step.move, state.u)
        # After a full step the supports are met; setting them avoids the last bit of round-off.
        u = jnp.where(held & admissible & (fraction == 1.0), state.level * held_values, u)
        placed = jnp.all(jnp.where(held, u == state.level * held_values, True))
        _, error = balanced(u, state.level)
        error = jnp.where(placed & admissible & jnp.isfinite(error), error, jnp.inf)
        state = state._replace(
            obstacle=_obstacle(step, crushed),
            crawled=state.crawled + ((fraction < _CRAWL) | (crushed & (fraction < 0.5))),
        )
        after = _next_level(options, state, u, admissible, error)
        if state.volumes is None or step.condensed is None:
            return after
        moved = advance(system.scene, state.volumes, step.condensed, step.move, fraction)
        back = volumes_of(after.u)
        # A level given up starts again from the last solution, whose volumes are its own.
        kept = after.level == state.level
        return after._replace(volumes=jax.tree.map(lambda a, b: jnp.where(kept, a, b), moved, back))

    def running(state: _State) -> jax.Array:
        return state.status == Status.RUNNING

    _, error = balanced(start, jnp.array(1.0))
    placed = jnp.all(jnp.where(held, start == held_values, True))
    fine = jnp.all(jnp.isfinite(start)) & jnp.all(jnp.isfinite(theta))
    inverted = ~(jnp.min(volume_ratio(system.scene, start)) > 0.0)
    status = jnp.where(
        ~fine,
        Status.INVALID_INPUT,
        jnp.where(placed & (error <= options.tolerance), Status.CONVERGED, Status.RUNNING),
    )
    # An inverted start is no start: begin at rest.
    u = jnp.where(fine & ~inverted, start, 0.0)
    state = _State(
        u=u,
        volumes=volumes_of(u),
        level=jnp.array(1.0),
        u_reached=jnp.zeros_like(u),
        reached=jnp.array(0.0),
        increment=jnp.array(1.0),
        at_level=jnp.array(0),
        iterations=jnp.array(0),
        error=jnp.where(fine & placed, error, jnp.inf),
        status=jnp.asarray(status, dtype=jnp.int64),
        obstacle=jnp.asarray(Status.LOAD_LIMIT, dtype=jnp.int64),
        crawled=jnp.array(0),
    )
    state = jax.lax.while_loop(running, step, state)
    converged = state.status == Status.CONVERGED
    u = jnp.where(converged, state.u, state.u_reached)
    return Solution(
        displacement=u,
        status=state.status,
        iterations=state.iterations,
        residual=state.error,
        load_reached=jnp.where(converged, 1.0, state.reached),
    )


def _full_step(system: System, state: _State, theta: jax.Array, move_held: jax.Array) -> _Step:
    """Newton's step from ``state``, turned round where it would climb the potential."""
    u, level = state.u, state.level
    if state.volumes is None:
        condensed = None
        residual = system.residual(u, theta, level)
        values = system.tangent(u, theta, level)
        # K times the held displacement, without assembling the held columns.
        _, pull = jax.jvp(lambda v: system.residual(v, theta, level), (u,), (move_held,))
    else:
        condensed = linearise(system.scene, u, state.volumes, theta)
        residual, pull = system.mixed_residual(u, theta, level, condensed, move_held)
        values = system.assemble(condensed.tangent, u, theta, level)
    solvable = system.pattern.solvable(values)
    values = system.pattern.safe_values(values)
    move = system.solve(values, -(residual + pull))
    slope = jnp.vdot(residual, move)
    settled = jnp.all(move_held == 0.0)
    if condensed is None:
        move = jnp.where(settled & (slope > 0.0), -move, move)
    return _Step(
        move=system.extend(move) + move_held,
        residual=residual,
        slope=slope,
        settled=settled,
        solvable=solvable,
        condensed=condensed,
        values=values,
        pull=pull,
    )


def _obstacle(step: _Step, crushed: jax.Array) -> jax.Array:
    """The status that says why a step was not longer."""
    force = jnp.max(jnp.abs(step.residual + step.pull))
    stiffness = jnp.max(jnp.abs(step.values))
    endless = ~(stiffness * jnp.max(jnp.abs(step.move)) <= _ENDLESS * force)
    short = jnp.where(crushed, Status.INVERTED_ELEMENT, Status.LOAD_LIMIT)
    return jnp.where(~step.solvable | endless, Status.SINGULAR_TANGENT, short)


def _size(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))


def _acceptance(
    system: System, options: NewtonOptions, state: _State, theta: jax.Array, step: _Step
) -> Callable[[jax.Array], jax.Array]:
    """Whether a fraction of the step makes progress."""
    if step.condensed is not None:
        return _natural(system, options, state, theta, step)
    return _lowering(system, state, theta, step)


def _natural(
    system: System, options: NewtonOptions, state: _State, theta: jax.Array, step: _Step
) -> Callable[[jax.Array], jax.Array]:
    """Natural monotonicity, for mean dilatation."""
    volumes, condensed = state.volumes, step.condensed
    assert volumes is not None
    assert condensed is not None

    def approaches(fraction: jax.Array) -> jax.Array:
        after = advance(system.scene, volumes, condensed, step.move, fraction)
        u = state.u + fraction * step.move
        elements = carried(system.scene, u, after, theta, condensed)
        left = system.spread(elements) + system.others(u, theta, state.level)
        rest = -(system.restrict(left) + (1.0 - fraction) * step.pull)
        rest = system.extend(system.solve(step.values, rest))
        rest = rest + (1.0 - fraction) * jnp.where(system.scene.held, step.move, 0.0)
        nearer = _size(rest) <= (1.0 - 0.25 * fraction) * _size(step.move)
        # Where round-off is all that is left, it cannot be told from progress.
        return nearer | ((state.at_level > 0) & (state.error <= options.round_off))

    return approaches


def _lowering(
    system: System, state: _State, theta: jax.Array, step: _Step
) -> Callable[[jax.Array], jax.Array]:
    """Armijo's rule on the potential energy."""
    follower = system.follower_force(state.u, theta)
    energy, size = system.potential(state.u, theta, state.level, follower)
    # Near the solution the decrease drowns in the round-off of the energy's parts.
    ceiling = energy + _ROUND_OFF * size
    descent = jnp.where(step.settled, -_ARMIJO * jnp.abs(step.slope), jnp.inf)

    def lowers(fraction: jax.Array) -> jax.Array:
        trial = state.u + fraction * step.move
        after, _ = system.potential(trial, theta, state.level, follower)
        lower = after <= ceiling + fraction * descent
        if system.forces:
            left = system.residual(trial, theta, state.level)
            lower |= jnp.sum(left**2) < (1.0 - _ARMIJO * fraction) * jnp.sum(step.residual**2)
        return lower

    return lowers


def _guard(
    system: System, state: _State, step: _Step, shrink: float
) -> Callable[[jax.Array], jax.Array]:
    """Whether a fraction of the step leaves too little of an element's volume."""
    floor = shrink * jnp.min(volume_ratio(system.scene, state.u))

    def crushes(fraction: jax.Array) -> jax.Array:
        J = volume_ratio(system.scene, state.u + fraction * step.move)
        fits = jnp.min(J) > floor  # written so that NaN does not fit
        if state.volumes is not None and step.condensed is not None:
            after = advance(system.scene, state.volumes, step.condensed, step.move, fraction)
            fits &= jnp.min(after.change) > -1.0
        return ~fits

    return crushes


_Search = tuple[jax.Array, jax.Array, jax.Array]


def _largest_fraction(
    crushes: Callable[[jax.Array], jax.Array],
    accepts: Callable[[jax.Array], jax.Array],
    least: float,
) -> tuple[jax.Array, jax.Array]:
    """Most of a step that will do, among 1, 1/2, 1/4, ... down to ``least``; 0 where none will.

    And whether elements were what forbade more of it.
    """

    def judged(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
        crush = crushes(fraction)
        return crush | ~accepts(fraction), crush

    def unfinished(search: _Search) -> jax.Array:
        fraction, unfit, _ = search
        return (fraction > least) & unfit

    def halved(search: _Search) -> _Search:
        fraction, _, before = search
        unfit, crush = judged(0.5 * fraction)
        return 0.5 * fraction, unfit, jnp.where(unfit, crush, before)

    unfit, crush = judged(jnp.array(1.0))
    search = (jnp.array(1.0), unfit, crush)
    fraction, unfit, crushed = jax.lax.while_loop(unfinished, halved, search)
    return jnp.where(unfit, 0.0, fraction), crushed


def _next_level(
    options: NewtonOptions,
    state: _State,
    u: jax.Array,
    admissible: jax.Array,
    error: jax.Array,
) -> _State:
    """Stay, move on to a higher load level, or fall back to a lower one."""
    iterations, at_level = state.iterations + 1, state.at_level + 1
    stalled = (error <= options.round_off) & (error > 0.3 * state.error) & (at_level > 1)
    solved = (error <= options.tolerance) | stalled
    complete = solved & (state.level >= 1.0)
    # Short steps one after the other lead nowhere, or slowly: a smaller load gets there sooner.
    halved = 0.5 * (state.level - state.reached)
    hopeless = (state.crawled >= _CRAWLS) & (halved >= options.min_increment)
    failed = ~solved & (~admissible | hopeless | (at_level >= options.level_iterations))
    # Easy levels earn a longer next step, failures a shorter one.
    increment = jnp.where(solved & (at_level <= 8), 2.0 * state.increment, state.increment)
    increment = jnp.where(failed, halved, increment)
    reached = jnp.where(solved, state.level, state.reached)
    u_reached = jnp.where(solved, u, state.u_reached)
    status = jnp.where(
        complete,
        Status.CONVERGED,
        jnp.where(
            failed & (increment < options.min_increment),
            state.obstacle,
            jnp.where(iterations >= options.max_iterations, Status.ITERATION_LIMIT, Status.RUNNING),
        ),
    )
    moved = solved | failed
    level = jnp.where(moved & ~complete, jnp.minimum(1.0, reached + increment), state.level)
    return state._replace(
        u=jnp.where(failed, u_reached, u),
        level=level,
        u_reached=u_reached,
        reached=reached,
        increment=increment,
        at_level=jnp.where(moved, 0, at_level),
        crawled=jnp.where(moved, 0, state.crawled),
        iterations=iterations,
        error=error,
        status=jnp.asarray(status, dtype=state.status.dtype),
    )
