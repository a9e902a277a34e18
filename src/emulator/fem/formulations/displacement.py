r"""Newton's method with the displacement as the only unknown, the formulation that others extend.

.. math::
    K = \int \left(\frac{\partial H}{\partial u}\right)^T
        \frac{\partial^2 W}{\partial H^2} \frac{\partial H}{\partial u}
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.compiled import cond
from emulator.fem.solution import NewtonState

# Relative residual above which the load stiffness is left out of the tangent
# (docs/experiments.md, "Fewer factorisations from rest").
UNBALANCED = 0.5

MonotonicityTest = Callable[[jax.Array], jax.Array]
"""Whether a fraction of a step leads towards the saddle point, ()."""


class Linearised(NamedTuple):
    """The linear equations of a step.

    tangent : the nonzeros (nnz,) of the tangent, mN/mm.
    solvable : whether the tangent can be factorised.
    residual : the residual, (f,) mN.
    offset_force : the change of the residual as the prescribed displacements go to their values,
        (f,) mN.
    couplings : the data by which :meth:`Displacement.advance` updates other unknowns, or None.
    """

    tangent: jax.Array
    solvable: jax.Array
    residual: jax.Array
    offset_force: jax.Array
    couplings: Any = None


@dataclass(frozen=True, eq=False)
class Displacement:
    """How Newton's method solves for the displacement, and for the other unknowns of subclasses.

    The *auxiliary* unknowns are a tree of arrays, or None. With a tree, even an empty one, the
    solution is no minimum, and :meth:`monotonicity_test` judges a step; without, the potential
    energy does.
    """

    system: System

    @staticmethod
    def serves(system: System) -> bool:
        """Return whether the formulation can solve the equations of ``system``."""
        return system.scene.dilatation == "pointwise"

    def begin(self, u: jax.Array, theta: jax.Array) -> Any:
        """Return the auxiliary unknowns that follow from the displacement ``u`` (n, 3) mm."""

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """Return the equations with the tangent at ``state``, or with the one it keeps."""
        factor = _load_stiffness(state.relative_residual, state.load)
        return self._renewed_or_kept(state, theta, factor)

    def monotonicity_test(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, step: jax.Array
    ) -> MonotonicityTest | None:
        """Return the test of fractions of ``step`` (n, 3) mm; None where the potential judges."""

    def advance(self, auxiliary: Any, couplings: Any, step: jax.Array, fraction: jax.Array) -> Any:
        """Return ``auxiliary`` after ``fraction`` of the full ``step`` (n, 3) mm."""

    def _renewed_or_kept(
        self, state: NewtonState, theta: jax.Array, load_stiffness: jax.Array
    ) -> Linearised:
        """Return the equations with a new tangent, or with the one that ``state`` keeps.

        A kept tangent stays the same to the bit: the solver knows its factor by the tangent's
        values.

        load_stiffness : the factor of the loads' stiffness in a new tangent.
        """
        tangent, solvable, offset_force = cond(
            state.renew,
            lambda: self.system.step_equations(state.u, theta, load_stiffness, state.load),
            lambda: (state.tangent, jnp.array(True), jnp.zeros_like(state.residual)),
        )
        return Linearised(tangent, solvable, state.residual, offset_force)


@jax.jit
def _load_stiffness(relative_residual: jax.Array, load: jax.Array) -> jax.Array:
    """Return the factor of the loads' stiffness in the tangent.

    Loads that nothing balances yet add none: a pressure softens the tangent of a body that does not
    resist it, and the step would lead nowhere useful.
    """
    return jnp.where(relative_residual > UNBALANCED, 0.0, load)
