r"""Newton's method for the stress-free shape of a body whose loaded shape is known.

The equations are those of :mod:`emulator.fem.inverse`. Their solution is no minimum, so a step is
judged by natural monotonicity (:mod:`.mean_dilatation`). Where blocks share a volume change, it and
the pressure are iterates and are eliminated; elsewhere nothing else is iterated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from emulator.fem.formulations.protocol import Linearised, Nearer
from emulator.fem.inverse_blocks import Couplings, Volumes, advance, carried, consistent, linearise
from emulator.fem.loop import compiled, cond
from emulator.fem.state import NewtonState
from emulator.fem.system import System

Iterates = Volumes | tuple[()]


@dataclass(frozen=True, eq=False)
class Inverse:
    """The way from the loaded shape to the stress-free one: see :class:`Formulation`."""

    system: System

    @staticmethod
    def serves(system: System) -> bool:
        """Equations of inverse motion."""
        return system.inverse

    @property
    def programs(self) -> dict[Callable, Callable]:
        """Compiled functions, of the system's."""
        return self.system.programs

    @compiled
    def begin(self, u: jax.Array, theta: jax.Array) -> Iterates:
        """Volumes and pressures that follow from ``u`` (n, 3)."""
        return consistent(self.system.scene, u, theta)

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """The equations at ``state``, volumes eliminated, or with the tangent it keeps."""
        if not state.alone:
            return self._linearise(state.u, state.iterates, theta, state.level)
        nothing = jnp.zeros_like(state.residual)
        tangent, solvable, pull = cond(
            state.refresh,
            lambda: self.system.step_equations(state.u, theta, state.level, state.level),
            lambda: (state.tangent, jnp.array(True), nothing),
        )
        return Linearised(tangent, solvable, state.residual, pull, None)

    @compiled
    def _linearise(
        self, u: jax.Array, volumes: Iterates, theta: jax.Array, level: jax.Array
    ) -> Linearised:
        system = self.system
        condensed = linearise(system.scene, u, volumes, theta)
        residual = system.scatter(condensed.force) + system.others(u, theta, level)
        tangent, solvable, pull = system.equations(condensed.tangent, u, theta, level, level)
        at = condensed.couplings
        return Linearised(tangent, solvable, system.restrict(residual), pull, at)

    def nearer(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, move: jax.Array
    ) -> Nearer:
        """Whether a fraction of the step passes the test of natural monotonicity."""
        return partial(self._nearer, state.u, state.iterates, state.level, theta, equations, move)

    @compiled
    def _nearer(
        self,
        u: jax.Array,
        volumes: Iterates,
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
        left = system.extend(system.solve(equations.tangent, -force))
        kept_open = jnp.array(True)
        if isinstance(after, Volumes):
            kept_open = jnp.all(after.change > -1.0)
        return kept_open & (_size(left) <= (1.0 - 0.25 * fraction) * _size(move))

    @compiled
    def advance(
        self, iterates: Iterates, eliminated: Couplings | None, move: jax.Array, fraction: jax.Array
    ) -> Iterates:
        """Volumes and pressures after ``fraction`` of the step by ``move`` (n, 3) mm."""
        return advance(self.system.scene, iterates, eliminated, move, fraction)


def _size(field: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(field**2))
