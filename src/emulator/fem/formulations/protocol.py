"""The interface of a formulation: the equations of a step, its test, its other unknowns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax

from emulator.fem.assembly import System
from emulator.fem.state import NewtonState


class Linearised(NamedTuple):
    """The linear equations of a step.

    tangent : the nonzeros (nnz,) of the tangent, mN/mm.
    solvable : whether the tangent can be factorised.
    residual : the residual, (f,) mN.
    offset_force : the change of the residual as the prescribed displacements go to their values,
        (f,) mN.
    couplings : the data by which :meth:`Formulation.advance` updates other unknowns, or None.
    """

    tangent: jax.Array
    solvable: jax.Array
    residual: jax.Array
    offset_force: jax.Array
    couplings: Any


MonotonicityTest = Callable[[jax.Array], jax.Array]
"""Whether a fraction of a step leads towards the saddle point, ()."""


class Formulation(Protocol):
    """How Newton's method solves for the displacement and for its other unknowns.

    The *auxiliary* unknowns are a tree of arrays, or None. With a tree, even an empty one, the
    solution is no minimum, and :meth:`monotonicity_test` judges a step; without, the potential
    energy does.
    """

    @staticmethod
    def serves(system: System) -> bool:
        """Return whether the formulation can solve the equations of ``system``."""

    @property
    def system(self) -> System:
        """The equations of the scene."""

    def begin(self, u: jax.Array, theta: jax.Array) -> Any:
        """Return the auxiliary unknowns that follow from the displacement ``u`` (n, 3) mm."""

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """Return the equations at ``state``."""

    def monotonicity_test(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, step: jax.Array
    ) -> MonotonicityTest | None:
        """Return the test of fractions of ``step`` (n, 3) mm; None where the potential judges."""

    def advance(self, auxiliary: Any, couplings: Any, step: jax.Array, fraction: jax.Array) -> Any:
        """Return ``auxiliary`` after ``fraction`` of the full ``step`` (n, 3) mm."""
