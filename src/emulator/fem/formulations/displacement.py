r"""Newton's method with the displacement as the only unknown.

.. math::
    K = \int \left(\frac{\partial H}{\partial u}\right)^T
        \frac{\partial^2 W}{\partial H^2} \frac{\partial H}{\partial u}
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.compiled import cond
from emulator.fem.formulations.protocol import Linearised
from emulator.fem.state import NewtonState

# Relative residual above which the load stiffness is left out of the tangent
# (docs/experiments.md, "Fewer factorisations from rest").
UNBALANCED = 0.5


@dataclass(frozen=True, eq=False)
class Displacement:
    """The formulation with the displacement alone (:class:`.protocol.Formulation`)."""

    system: System

    @staticmethod
    def serves(system: System) -> bool:
        """Return whether every integration point has a volume ratio of its own."""
        return system.scene.dilatation == "pointwise"

    def begin(self, u: jax.Array, theta: jax.Array) -> None:
        """Return None: there is no other unknown."""

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """Return the equations with the tangent at ``state``, or with the one it keeps."""
        factor = _load_stiffness(state.relative_residual, state.load)
        return renewed_or_kept(self.system, state, theta, factor)

    def monotonicity_test(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, step: jax.Array
    ) -> None:
        """Return None: the potential energy judges steps."""

    def advance(
        self, auxiliary: None, couplings: None, step: jax.Array, fraction: jax.Array
    ) -> None:
        """Return None: there is no other unknown."""


def renewed_or_kept(
    system: System, state: NewtonState, theta: jax.Array, load_stiffness: jax.Array
) -> Linearised:
    """Return the equations with a new tangent, or with the one that ``state`` keeps.

    A kept tangent stays the same to the bit: the solver knows its factor by the tangent's values.

    load_stiffness : the factor of the loads' stiffness in a new tangent.
    """
    tangent, solvable, offset_force = cond(
        state.renew,
        lambda: system.step_equations(state.u, theta, load_stiffness, state.load),
        lambda: (state.tangent, jnp.array(True), jnp.zeros_like(state.residual)),
    )
    return Linearised(tangent, solvable, state.residual, offset_force, None)


@jax.jit
def _load_stiffness(relative_residual: jax.Array, load: jax.Array) -> jax.Array:
    """Return the factor of the loads' stiffness in the tangent.

    Loads that nothing balances yet add none: a pressure softens the tangent of a body that does not
    resist it, and the step would lead nowhere useful.
    """
    return jnp.where(relative_residual > UNBALANCED, 0.0, load)
