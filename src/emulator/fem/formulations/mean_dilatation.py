r"""Newton's method for mean dilatation, with each block's volume and pressure as iterates.

They are eliminated block by block (:mod:`emulator.fem.condensation`).

The solution is a saddle point, so no energy can judge a step, and the residual is dominated by the
stiff volumes. Deuflhard's natural monotonicity test does: the simplified Newton step (with the old
tangent) after a fraction of the step must be shorter than the step,

.. math::
    \left| K(x)^{-1} r(x + \alpha \Delta x) \right|
    \le \left(1 - \frac{\alpha}{4}\right) |\Delta x|

in mm (P. Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 3.3). The tangent is
factorised already, so the test costs one evaluation of the forces and one back-substitution
(docs/experiments.md, "Mean dilatation from far away: what judges a step").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from emulator.fem.condensation import (
    Condensed,
    Volumes,
    advance,
    carried,
    consistent,
    linearise,
)
from emulator.fem.formulations.protocol import Linearised, Nearer
from emulator.fem.loop import compiled
from emulator.fem.state import NewtonState
from emulator.fem.system import System


@dataclass(frozen=True, eq=False)
class MeanDilatation:
    """Volumes and pressures of the blocks are iterates, too: see :class:`Formulation`."""

    system: System

    @staticmethod
    def serves(system: System) -> bool:
        """A scene whose elements, or patches of them, share a volume ratio."""
        return system.scene.dilatation != "pointwise"

    @property
    def programs(self) -> dict[Callable, Callable]:
        """Compiled functions, of the system's."""
        return self.system.programs

    @compiled
    def begin(self, u: jax.Array, theta: jax.Array) -> Volumes:
        """Volumes and pressures that follow from the displacement ``u`` (n, 3)."""
        return consistent(self.system.scene, u, theta)

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """The equations at ``state``, volumes eliminated."""
        return self._linearise(state.u, state.iterates, theta, state.level)

    @compiled
    def _linearise(
        self, u: jax.Array, volumes: Volumes, theta: jax.Array, level: jax.Array
    ) -> Linearised:
        system = self.system
        condensed = linearise(system.scene, u, volumes, theta)
        residual = system.scatter(condensed.force) + system.others(u, theta, level)
        tangent, solvable, pull = system.equations(condensed.tangent, u, theta, level, level)
        return Linearised(tangent, solvable, system.restrict(residual), pull, condensed)

    def nearer(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, move: jax.Array
    ) -> Nearer:
        """Whether a fraction of the step passes the test of natural monotonicity."""
        return partial(self._nearer, state.u, state.iterates, state.level, theta, equations, move)

    @compiled
    def _nearer(
        self,
        u: jax.Array,
        volumes: Volumes,
        level: jax.Array,
        theta: jax.Array,
        equations: Linearised,
        move: jax.Array,
        fraction: jax.Array,
    ) -> jax.Array:
        system, at = self.system, equations.eliminated
        after = advance(system.scene, volumes, at, move, fraction)
        there = u + fraction * move
        force = system.scatter(carried(system.scene, there, after, theta, at))
        force = system.restrict(force + system.others(there, theta, level))
        rest = 1.0 - fraction
        left = system.extend(system.solve(equations.tangent, -(force + rest * equations.pull)))
        left = left + rest * jnp.where(system.scene.held, move, 0.0)
        kept_open = jnp.min(after.change) > -1.0
        return kept_open & (_size(left) <= (1.0 - 0.25 * fraction) * _size(move))

    @compiled
    def advance(
        self, iterates: Volumes, eliminated: Condensed, move: jax.Array, fraction: jax.Array
    ) -> Volumes:
        """Volumes and pressures after ``fraction`` of the step by ``move`` (n, 3) mm."""
        return advance(self.system.scene, iterates, eliminated, move, fraction)


def _size(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))
