r"""Newton's method with adaptive load steps: one iteration as a pure function of its state.

At load level :math:`s \in (0, 1]` the loads are :math:`s f` and the held displacements
:math:`s \bar u`. An iteration is a descent direction (:mod:`.direction`), the part of it that is
taken (:mod:`.step_length`, :mod:`.line_search`) and the decision what comes next
(:mod:`.load_control`). Loads without a potential are held at their present force while a step is
judged, and a step that lowers the residual instead will do.

Two things save factorisations, most of the cost. The tangent of the last iteration is kept while a
step with it cuts the residual at least tenfold. And as long as the loads are hardly balanced, as
at rest, their own stiffness is left out of the tangent.

What is iterated besides the displacement, and how the equations are linearised, is the
formulation's (:mod:`emulator.fem.formulations`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from emulator.fem.balance import forces_at, level_balance
from emulator.fem.formulations import formulation_of
from emulator.fem.loop import cond
from emulator.fem.newton.direction import Direction, newton_direction
from emulator.fem.newton.load_control import next_state
from emulator.fem.newton.step_length import Outcome, take_step
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Status
from emulator.fem.state import Negligible, NewtonState
from emulator.fem.system import System

_ROUND_OFF = 1e-15  # strain that floating point cannot tell from none
_STILL = 1e-12  # of the body's size: a correction that may be round-off
_STRETCH = 1e-6  # small enough for the forces to be linear in it


@dataclass(frozen=True, eq=False)
class Newton:
    """The iteration for one theta."""

    system: System
    options: NewtonOptions
    theta: jax.Array

    def begin(self, start: jax.Array, negligible: Negligible | None = None) -> NewtonState:
        """The state to iterate from: ``start``, or rest where that is no start.

        negligible : what may be round-off, if known.
        """
        system, theta = self.system, self.theta
        negligible = self.negligible() if negligible is None else negligible
        residual, error = level_balance(system, start, theta, jnp.ones(()))
        least_J = system.least_volume_ratio(start)
        state = _first(
            theta,
            start,
            residual,
            error,
            negligible,
            least_J,
            entries=len(system.pattern.rows),
            options=self.options,
        )
        return state._replace(iterates=formulation_of(system).begin(state.u, theta))

    def negligible(self) -> Negligible:
        r"""Residual in mN that may be round-off: :math:`10^{-15} |K_0 X|`; and correction in mm.

        A uniform stretch by 1e-15 of the body at rest changes the internal forces by so much; it is
        taken from a stretch by 1e-6. Without loads there is no other force to compare a residual
        with. On a slender body, or beside stiff springs, such a residual may still matter, so the
        step that Newton's method takes for it must be short as well.
        """
        X = jnp.asarray(self.system.scene.mesh.nodes)
        stretched = forces_at(self.system, _STRETCH * X, self.theta, 0.0)
        size = _ROUND_OFF / _STRETCH * stretched.internal
        extent = jnp.ptp(X, axis=0).max()
        return Negligible(jnp.where(jnp.isfinite(size), size, 0.0), _STILL * extent)

    def step(self, state: NewtonState, any_tangent: jax.Array | bool = True) -> NewtonState:
        """One iteration.

        any_tangent : whether a tangent that is not positive definite will do; without, the state
            stays where it is at such a one, and is no longer convex.
        """
        system, theta = self.system, self.theta
        residual, error = cond(
            state.at_level == 0,
            lambda: level_balance(system, state.u, theta, state.level),
            lambda: (state.residual, state.error),
        )
        state = state._replace(residual=residual, error=error)
        direction = newton_direction(system, theta, state, any_tangent=any_tangent)
        convex = state.convex & direction.definite
        state = state._replace(convex=convex)
        return cond(direction.refused, lambda: state, lambda: self._after(state, direction))

    def _after(self, state: NewtonState, direction: Direction) -> NewtonState:
        """The state after the part of a step that is taken."""
        outcome = take_step(self.system, self.theta, state, direction, self.options)
        state = state._replace(tangent=direction.equations.tangent, singular=direction.singular)
        after = next_state(state, outcome, direction.descends, direction.move, self.options)
        if state.iterates is None:
            return after
        return after._replace(iterates=self._iterates(state, outcome, direction, after))

    def _iterates(
        self, state: NewtonState, outcome: Outcome, direction: Direction, after: NewtonState
    ) -> Any:
        """Iterates after the step; of the last solution where the level has changed."""
        formulation = formulation_of(self.system)
        move = jnp.where(outcome.fraction > 0.0, direction.move, 0.0)
        return cond(
            after.level == state.level,
            lambda: formulation.advance(
                state.iterates, direction.equations.eliminated, move, outcome.fraction
            ),
            lambda: formulation.begin(after.u, self.theta),
        )


@partial(jax.jit, static_argnames=("entries", "options"))
def _first(
    theta: jax.Array,
    start: jax.Array,
    residual: jax.Array,
    error: jax.Array,
    negligible: Negligible,
    least_J: jax.Array,
    *,
    entries: int,
    options: NewtonOptions,
) -> NewtonState:
    """The state at ``start`` or at rest, for tangents of ``entries``; iterates left out."""
    fine = jnp.all(jnp.isfinite(start)) & jnp.all(jnp.isfinite(theta))
    inverted = ~(least_J > 0.0)
    balanced = (error <= options.tolerance) | (jnp.linalg.norm(residual) <= options.absolute)
    solved = ~inverted & balanced & jnp.isfinite(error)
    status = jnp.where(solved, Status.CONVERGED, Status.RUNNING)
    u = jnp.where(fine & ~inverted, start, 0.0)
    count, increment = jnp.zeros((), dtype=int), jnp.full((), options.increment, float)
    return NewtonState(
        u=u,
        iterates=None,
        level=increment,
        u_reached=jnp.zeros_like(u),
        reached=jnp.zeros(()),
        increment=increment,
        at_level=count,
        iterations=count,
        factorisations=count,
        residual=residual,
        error=jnp.where(fine, error, jnp.inf),
        negligible=negligible,
        tangent=jnp.zeros(entries),
        refresh=jnp.array(True),
        convex=jnp.array(True),
        careful=jnp.full((), jnp.inf, float),
        crushed=jnp.array(False),
        singular=jnp.array(False),
        flattened=count,
        status=jnp.asarray(jnp.where(fine, status, Status.INVALID_INPUT), dtype=jnp.int64),
    )
