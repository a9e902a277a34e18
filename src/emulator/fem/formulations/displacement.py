r"""Newton's method for the displacement alone.

.. math::
    K = \int \left(\frac{\partial H}{\partial u}\right)^T
        \frac{\partial^2 W}{\partial H^2} \frac{\partial H}{\partial u}
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from emulator.fem.formulations.protocol import Linearised
from emulator.fem.loop import cond
from emulator.fem.state import UNBALANCED, NewtonState
from emulator.fem.system import System


@dataclass(frozen=True, eq=False)
class Displacement:
    """The displacement is all that is iterated: see :class:`Formulation`."""

    system: System

    @staticmethod
    def serves(system: System) -> bool:
        """Any scene whose points have volume ratios of their own."""
        return system.scene.dilatation == "pointwise"

    def begin(self, u: jax.Array, theta: jax.Array) -> None:
        """Nothing else is iterated."""

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """The tangent at ``state``, or the one it keeps.

        A kept tangent stays the same to the bit: the solver knows its factor by its values.
        """
        stiffening = _stiffening(state.error, state.level)
        tangent, solvable, pull = cond(
            state.refresh,
            lambda: self.system.step_equations(state.u, theta, stiffening, state.level),
            lambda: (state.tangent, jnp.array(True), jnp.zeros_like(state.residual)),
        )
        return Linearised(tangent, solvable, state.residual, pull, None)

    def nearer(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, move: jax.Array
    ) -> None:
        """The potential energy judges."""

    def advance(
        self, iterates: None, eliminated: None, move: jax.Array, fraction: jax.Array
    ) -> None:
        """Nothing else is iterated."""


@jax.jit
def _stiffening(error: jax.Array, level: jax.Array) -> jax.Array:
    """Load level whose stiffness the tangent holds.

    Loads that nothing balances yet lend none: a pressure softens the tangent of a body that does
    not resist it and points the step nowhere useful.
    """
    return jnp.where(error > UNBALANCED, 0.0, level)
