"""What a formulation does: the equations of a step, what judges it, what it changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax

from emulator.fem.state import NewtonState
from emulator.fem.system import System


class Linearised(NamedTuple):
    """The equations of a step.

    tangent : (nnz,) mN/mm. solvable : whether it can be factorised. residual : (f,) mN.
    pull : (f,) mN, the change of the residual as the supports are moved.
    eliminated : what :meth:`Formulation.advance` needs to know, or None.
    """

    tangent: jax.Array
    solvable: jax.Array
    residual: jax.Array
    pull: jax.Array
    eliminated: Any


Nearer = Callable[[jax.Array], jax.Array]
"""Of a fraction of a step: whether it leads nearer to the saddle, shape ()."""


class Formulation(Protocol):
    """How Newton's method solves for the displacement, and what else it iterates on.

    ``iterates`` are a tree of arrays besides the displacement, or None. With them, were the tree
    empty, the point sought is no minimum, and :meth:`nearer` judges a step; without, the potential
    energy does.
    """

    @staticmethod
    def serves(system: System) -> bool:
        """Whether it can solve the equations of ``system``."""

    @property
    def system(self) -> System:
        """The equations of the scene."""

    def begin(self, u: jax.Array, theta: jax.Array) -> Any:
        """The iterates that belong to the displacement ``u`` (n, 3) mm."""

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """The equations at ``state``."""

    def nearer(
        self, state: NewtonState, theta: jax.Array, equations: Linearised, move: jax.Array
    ) -> Nearer | None:
        """What judges the step ``move`` (n, 3); None without iterates."""

    def advance(self, iterates: Any, eliminated: Any, move: jax.Array, fraction: jax.Array) -> Any:
        """``iterates`` after ``fraction`` of a step by ``move`` (n, 3) mm."""
