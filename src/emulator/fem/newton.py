r"""Newton's method with adaptive load steps, as one loop inside ``jax.jit``.

At load level :math:`s \in (0, 1]` the loads are :math:`s f` and the held displacements
:math:`s \bar u`. Each iteration solves

.. math::
    K\, \Delta u = -\left[r_s(u) + K\, \Delta \bar u\right], \qquad
    \Delta \bar u = s \bar u - u|_\text{held}

and steps by an :math:`\alpha \in \{1, \tfrac12, \tfrac14, \dots\}` that keeps every element's
:math:`J` above a fraction of its present least value and, once the supports are met, lowers the
potential energy (Armijo's rule; where the tangent is indefinite and Newton's direction climbs, the
opposite one is taken). Exponential laws diverge without it. Loads without a potential
are held at their present force for this rule, and a step that lowers the residual instead will do.
A level that does not converge is tried again with half the load increment.

Two things save factorisations, most of the cost. The tangent of the last iteration is kept while a
step with it cuts the residual at least tenfold. And as long as the loads are hardly balanced, as
at rest, their own stiffness is left out: a pressure that nothing resists yet softens the tangent
and points the step nowhere useful.

With mean dilatation the elements' volumes and pressures are iterates of their own (see
:mod:`emulator.fem.mixed`); the point sought is then a saddle, and steps are judged by
:mod:`emulator.fem.natural` monotonicity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System, balance
from emulator.fem.functional import volume_ratio
from emulator.fem.line_search import Direction, choose_fraction
from emulator.fem.mixed import Condensed, Volumes, advance, consistent, linearise
from emulator.fem.natural import natural_monotonicity
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution, Status

NEAR = 0.05  # relative residual below which a step is judged by the residual alone
UNBALANCED = 0.5  # and above which the stiffness of the loads misleads
_SQUEEZES = 8  # steps kept short by elements after which a load step is halved
_ENDLESS = 1e13  # a step this much longer than force over stiffness: a singular tangent
_MIXED_ITERATIONS = 20  # a mixed load step that works takes about ten


class NewtonState(NamedTuple):
    """What the next iteration needs."""

    u: jax.Array  # (n, 3) current iterate
    volumes: Volumes | None  # that go with it, for mean dilatation
    level: jax.Array  # load level being solved
    u_reached: jax.Array  # (n, 3) solution at the last level that converged
    reached: jax.Array  # that level
    increment: jax.Array
    at_level: jax.Array  # iterations spent at this level
    iterations: jax.Array
    factorisations: jax.Array
    residual: jax.Array  # (f,) at `u` and `level`, unless at_level is 0
    error: jax.Array  # the same relative to the forces at work; inf until the supports are met
    tangent: jax.Array  # (nnz,) the last one assembled
    refresh: jax.Array  # whether the next iteration needs a new one
    crushed: jax.Array  # whether the last level was given up because elements would invert
    singular: jax.Array  # whether the last step came of a singular tangent
    squeezed: jax.Array  # steps at this level that elements about to be crushed kept short
    status: jax.Array

    def forget_tangent(self, system: System) -> NewtonState:
        """The same state for a ``system`` that stores tangents in another way."""
        empty = jnp.zeros(len(system.pattern.rows))
        return self._replace(tangent=empty, refresh=jnp.array(True))


class _Outcome(NamedTuple):
    """Where a step leads; fraction 0 means nowhere."""

    u: jax.Array
    residual: jax.Array
    error: jax.Array
    fraction: jax.Array
    crushed: jax.Array


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
    solver = Newton(system, options, theta)
    return solution_of(
        jax.lax.while_loop(
            lambda state: state.status == Status.RUNNING, solver.step, solver.begin(start)
        )
    )


def solution_of(state: NewtonState) -> Solution:
    """What the iteration ended with."""
    converged = state.status == Status.CONVERGED
    return Solution(
        displacement=jnp.where(converged, state.u, state.u_reached),
        status=state.status,
        iterations=state.iterations,
        factorisations=state.factorisations,
        residual=state.error,
        load_reached=jnp.where(converged, 1.0, state.reached),
    )


@dataclass(frozen=True, eq=False)
class Newton:
    """The iteration for one theta."""

    system: System
    options: NewtonOptions
    theta: jax.Array

    def begin(self, start: jax.Array) -> NewtonState:
        """The state to iterate from: ``start``, or rest where that is no start."""
        residual, error = self._balance(start, jnp.array(1.0))
        fine = jnp.all(jnp.isfinite(start)) & jnp.all(jnp.isfinite(self.theta))
        inverted = ~(jnp.min(volume_ratio(self.system.scene, start)) > 0.0)
        solved = ~inverted & (error <= self.options.tolerance)
        status = jnp.where(solved, Status.CONVERGED, Status.RUNNING)
        u = jnp.where(fine & ~inverted, start, 0.0)
        return NewtonState(
            u=u,
            volumes=consistent(self.system.scene, u, self.theta) if self.system.mixed else None,
            level=jnp.array(self.options.increment),
            u_reached=jnp.zeros_like(u),
            reached=jnp.array(0.0),
            increment=jnp.array(self.options.increment),
            at_level=jnp.array(0),
            iterations=jnp.array(0),
            factorisations=jnp.array(0),
            residual=residual,
            error=jnp.where(fine, error, jnp.inf),
            tangent=jnp.zeros(len(self.system.pattern.rows)),
            refresh=jnp.array(True),
            crushed=jnp.array(False),
            singular=jnp.array(False),
            squeezed=jnp.array(0),
            status=jnp.asarray(jnp.where(fine, status, Status.INVALID_INPUT), dtype=jnp.int64),
        )

    def step(self, state: NewtonState) -> NewtonState:
        """One iteration."""
        residual, error = jax.lax.cond(
            state.at_level == 0,
            lambda: self._balance(state.u, state.level),
            lambda: (state.residual, state.error),
        )
        state = state._replace(residual=residual, error=error)
        tangent, direction, condensed = self._direction(state)
        quick = self._full_step(state, direction)
        # A kept tangent is worth a full step or nothing: its direction is not searched along.
        outcome = jax.lax.cond(
            (quick.fraction > 0.0) | ~state.refresh,
            lambda: quick,
            lambda: self._searched_step(state, direction, tangent, condensed),
        )
        state = state._replace(singular=direction.singular)
        after = self._next_level(state, outcome, tangent)
        if state.volumes is None or condensed is None:
            return after
        return after._replace(volumes=self._volumes(state, outcome, direction, condensed, after))

    def _balance(self, u: jax.Array, level: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Residual (f,) and its relative size, infinite unless finite and the supports are met."""
        residual, error = balance(self.system, u, self.theta, level, self.options.absolute)
        placed = jnp.all(self._offset(u, level) == 0.0)
        return residual, jnp.where(placed & jnp.isfinite(error), error, jnp.inf)

    def _offset(self, u: jax.Array, level: jax.Array) -> jax.Array:
        """How far the held displacements are from where the level wants them, (n, 3) mm."""
        scene = self.system.scene
        wanted = level * scene.held_displacement
        # Fused multiply-add would find the last bit of the product missing in the difference.
        return jnp.where(scene.held & (u != wanted), wanted - u, 0.0)

    def _direction(self, state: NewtonState) -> tuple[jax.Array, Direction, Condensed | None]:
        """Newton's step, turned round where it would climb the potential, and its tangent."""
        system, u, level, theta = self.system, state.u, state.level, self.theta
        offset = self._offset(u, level)
        # See the module's docstring: loads that nothing balances yet lend no stiffness.
        stiffening = jnp.where(state.error > UNBALANCED, 0.0, level)
        settled = jnp.all(offset == 0.0)
        residual, condensed = state.residual, None

        def checked(tangent: jax.Array) -> tuple[jax.Array, jax.Array]:
            return system.pattern.safe_values(tangent), system.pattern.solvable(tangent)

        if state.volumes is None:
            # A kept tangent stays the same to the bit: the solver knows its factor by its values.
            tangent, solvable = jax.lax.cond(
                state.refresh,
                lambda: checked(system.tangent(u, theta, stiffening)),
                lambda: (state.tangent, jnp.array(True)),
            )
            # K times the held displacement, without assembling the held columns.
            pull = jax.lax.cond(
                settled,
                lambda: jnp.zeros_like(residual),
                lambda: jax.jvp(lambda v: system.residual(v, theta, stiffening), (u,), (offset,))[
                    1
                ],
            )
        else:
            condensed = linearise(system.scene, u, state.volumes, theta)
            residual, pull = system.mixed_residual(u, theta, level, condensed, offset)
            tangent, solvable = checked(system.assemble(condensed.tangent, u, theta, level))
        move = system.solve(tangent, -(residual + pull))
        slope = jnp.vdot(residual, move)
        if condensed is None:
            move = jnp.where(settled & (slope > 0.0), -move, move)
        move = system.extend(move) + offset
        direction = Direction(
            move=jnp.where(solvable, move, jnp.nan),
            residual=residual,
            pull=pull,
            slope=slope,
            settled=settled,
            singular=~solvable | self._endless(tangent, move, residual + pull),
        )
        return tangent, direction, condensed

    def _endless(self, tangent: jax.Array, move: jax.Array, force: jax.Array) -> jax.Array:
        """Whether a step is so long for its force that the tangent must be singular."""
        size = jnp.max(jnp.abs(tangent)) * jnp.max(jnp.abs(move))
        return ~(size <= _ENDLESS * jnp.max(jnp.abs(force)))

    def _full_step(self, state: NewtonState, direction: Direction) -> _Outcome:
        """The whole step where the residual alone can tell that it is good."""
        near = direction.settled & (state.error < NEAR) & (not self.system.mixed)
        trial = state.u + direction.move
        residual, error = self._balance(trial, state.level)
        J, now = (jnp.min(volume_ratio(self.system.scene, u)) for u in (trial, state.u))
        good = near & (error <= 0.5 * state.error) & (self.options.shrink * now < J)
        return _Outcome(
            u=jnp.where(good, trial, state.u),
            residual=jnp.where(good, residual, state.residual),
            error=jnp.where(good, error, state.error),
            fraction=jnp.where(good, 1.0, 0.0),
            crushed=jnp.array(False),
        )

    def _searched_step(
        self,
        state: NewtonState,
        direction: Direction,
        tangent: jax.Array,
        condensed: Condensed | None,
    ) -> _Outcome:
        """The part of the step that makes most progress."""
        system, u, level, theta = self.system, state.u, state.level, self.theta
        nearer = None
        if state.volumes is not None and condensed is not None:
            natural = natural_monotonicity(
                system, u, state.volumes, level, theta, condensed, tangent, direction
            )
            # Where round-off is all that is left, it cannot be told from progress.
            drowned = state.error <= self.options.round_off
            nearer = lambda fraction: drowned | natural(fraction)  # noqa: E731
        fraction, crushed = choose_fraction(
            system, u, level, theta, direction, self.options.shrink, nearer
        )
        u = jnp.where(fraction > 0.0, state.u + fraction * direction.move, state.u)
        # After a full step the supports are met; setting them avoids the last bit of round-off.
        scene = self.system.scene
        u = jnp.where(scene.held & (fraction == 1.0), state.level * scene.held_displacement, u)
        residual, error = self._balance(u, state.level)
        return _Outcome(u, residual, error, fraction, crushed)

    def _volumes(
        self,
        state: NewtonState,
        outcome: _Outcome,
        direction: Direction,
        condensed: Condensed,
        after: NewtonState,
    ) -> Volumes:
        """Volumes after the step; those of the last solution where the level has changed."""
        volumes, scene = state.volumes, self.system.scene
        assert volumes is not None
        move = jnp.where(outcome.fraction > 0.0, direction.move, 0.0)
        return jax.lax.cond(
            after.level == state.level,
            lambda: advance(scene, volumes, condensed, move, outcome.fraction),
            lambda: consistent(scene, after.u, self.theta),
        )

    def _next_level(self, state: NewtonState, outcome: _Outcome, tangent: jax.Array) -> NewtonState:
        """Stay, move on to a higher load level, or fall back to a lower one."""
        options, error = self.options, outcome.error
        iterations, at_level = state.iterations + 1, state.at_level + 1
        fresh, stuck = state.refresh, state.refresh & ~(outcome.fraction > 0.0)
        spent = at_level >= options.level_iterations
        if self.system.mixed:
            spent |= at_level >= _MIXED_ITERATIONS
        slow = fresh & (error > 0.3 * state.error) & (at_level > 1)
        solved = (error <= options.tolerance) | (slow & (error <= options.round_off))
        complete = solved & (state.level >= 1.0)
        halved = 0.5 * (state.level - state.reached)
        squeezed = state.squeezed + (outcome.crushed & (outcome.fraction < 0.5))
        # Elements flattened again and again lead nowhere: a lower load finds out sooner.
        spent |= (squeezed >= _SQUEEZES) & (halved >= options.min_increment)
        failed = ~solved & (stuck | spent)
        # Easy levels earn a longer next step, failures a shorter one.
        longer = jnp.minimum(2.0 * state.increment, options.increment)
        increment = jnp.where(solved & (at_level <= 8), longer, state.increment)
        increment = jnp.where(failed, halved, increment)
        reached = jnp.where(solved, state.level, state.reached)
        u_reached = jnp.where(solved, outcome.u, state.u_reached)
        crushed = jnp.where(failed, outcome.crushed, state.crushed)
        limit = jnp.where(crushed, Status.INVERTED_ELEMENT, Status.LOAD_LIMIT)
        limit = jnp.where(state.singular, Status.SINGULAR_TANGENT, limit)
        status = jnp.where(
            complete,
            Status.CONVERGED,
            jnp.where(
                failed & (increment < options.min_increment),
                limit,
                jnp.where(
                    iterations >= options.max_iterations, Status.ITERATION_LIMIT, Status.RUNNING
                ),
            ),
        )
        moved = solved | failed
        good = (outcome.fraction == 1.0) & jnp.isfinite(error)
        good &= error <= self.options.keep_tangent * state.error
        return state._replace(
            u=jnp.where(failed, u_reached, outcome.u),
            level=jnp.where(moved & ~complete, jnp.minimum(1.0, reached + increment), state.level),
            u_reached=u_reached,
            reached=reached,
            increment=increment,
            at_level=jnp.where(moved, 0, at_level),
            iterations=iterations,
            factorisations=state.factorisations + state.refresh,
            residual=outcome.residual,
            error=error,
            tangent=tangent,
            refresh=~good | moved | self.system.mixed,
            crushed=crushed,
            squeezed=jnp.where(moved, 0, squeezed),
            status=jnp.asarray(status, dtype=state.status.dtype),
        )
