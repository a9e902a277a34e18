r"""Newton's method with adaptive load steps: one iteration as a pure function of its state.

At load level :math:`s \in (0, 1]` the loads are :math:`s f` and the held displacements
:math:`s \bar u`. An iteration is a descent direction (:mod:`emulator.fem.direction`), the part of
it that is taken (:mod:`emulator.fem.step_length`, :mod:`emulator.fem.line_search`) and the decision
what comes next (:mod:`emulator.fem.load_control`). Loads without a potential are held at their
present force while a step is judged, and a step that lowers the residual instead will do.

Two things save factorisations, most of the cost. The tangent of the last iteration is kept while a
step with it cuts the residual at least tenfold. And as long as the loads are hardly balanced, as
at rest, their own stiffness is left out of the tangent.

With mean dilatation the elements' volumes and pressures are iterates of their own (see
:mod:`emulator.fem.mixed`); the point sought is then a saddle, and steps are judged by
:mod:`emulator.fem.natural` monotonicity.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.direction import Direction, newton_direction
from emulator.fem.functional import volume_ratio
from emulator.fem.load_control import next_state
from emulator.fem.mixed import Volumes, advance, consistent
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Status
from emulator.fem.state import NewtonState
from emulator.fem.step_length import Outcome, level_balance, take_step

_ROUND_OFF = 1e-15  # strain that floating point cannot tell from none


@dataclass(frozen=True, eq=False)
class Newton:
    """The iteration for one theta."""

    system: System
    options: NewtonOptions
    theta: jax.Array

    def begin(self, start: jax.Array) -> NewtonState:
        """The state to iterate from: ``start``, or rest where that is no start."""
        negligible = self.negligible()
        residual, error = level_balance(self.system, start, self.theta, jnp.array(1.0), negligible)
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
            negligible=negligible,
            tangent=jnp.zeros(len(self.system.pattern.rows)),
            refresh=jnp.array(True),
            convex=jnp.array(True),
            careful=jnp.array(jnp.inf),
            crushed=jnp.array(False),
            singular=jnp.array(False),
            squeezed=jnp.array(0),
            status=jnp.asarray(jnp.where(fine, status, Status.INVALID_INPUT), dtype=jnp.int64),
        )

    def negligible(self) -> jax.Array:
        r"""Residual in mN that is round-off: :math:`10^{-15} |K_0 X|`, at least ``absolute``.

        A uniform stretch by 1e-15 of the body at rest changes the internal forces by so much.
        Without loads there is no other force to compare a residual with.
        """
        X = jnp.asarray(self.system.scene.mesh.nodes)
        rest = jnp.zeros_like(X)
        _, force = jax.jvp(lambda u: self.system.internal_force(u, self.theta), (rest,), (X,))
        size = _ROUND_OFF * jnp.sqrt(jnp.sum(force**2))
        return jnp.maximum(jnp.where(jnp.isfinite(size), size, 0.0), self.options.absolute)

    def step(self, state: NewtonState) -> NewtonState:
        """One iteration."""
        system, theta = self.system, self.theta
        residual, error = jax.lax.cond(
            state.at_level == 0,
            lambda: level_balance(system, state.u, theta, state.level, state.negligible),
            lambda: (state.residual, state.error),
        )
        state = state._replace(residual=residual, error=error)
        direction = newton_direction(system, theta, state)
        outcome = take_step(system, theta, state, direction, self.options)
        convex = state.convex
        if direction.condensed is None:  # the point sought by mean dilatation is a saddle
            convex &= direction.descends
        state = state._replace(singular=direction.singular, convex=convex)
        after = next_state(state, outcome, direction.tangent, self.options)
        if state.volumes is None:
            return after
        return after._replace(volumes=self._volumes(state, outcome, direction, after))

    def _volumes(
        self, state: NewtonState, outcome: Outcome, direction: Direction, after: NewtonState
    ) -> Volumes:
        """Volumes after the step; of the last solution where the level has changed."""
        volumes, condensed, scene = state.volumes, direction.condensed, self.system.scene
        assert volumes is not None
        assert condensed is not None
        move = jnp.where(outcome.fraction > 0.0, direction.move, 0.0)
        return jax.lax.cond(
            after.level == state.level,
            lambda: advance(scene, volumes, condensed, move, outcome.fraction),
            lambda: consistent(scene, after.u, self.theta),
        )
