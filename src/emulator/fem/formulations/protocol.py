"""What a formulation does: the equations of a step, what judges it, what it changes."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Protocol

import jax

from emulator.fem.state import NewtonState
from emulator.fem.system import System
from emulator.scenes.scene import Scene


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


class Formulation(Protocol):
    """How Newton's method solves for the displacement, and what else it iterates on.

    ``iterates`` are a tree of arrays besides the displacement, or None. saddle : whether the point
    sought is one: :meth:`nearer` judges a step, where else the potential energy does.
    """

    saddle: ClassVar[bool]

    @staticmethod
    def serves(scene: Scene) -> bool:
        """Whether it can solve ``scene``."""

    @property
    def system(self) -> System:
        """The equations of the scene."""

    def begin(self, u: jax.Array, theta: jax.Array) -> Any:
        """The iterates that belong to the displacement ``u`` (n, 3) mm."""

    def linearise(self, state: NewtonState, theta: jax.Array) -> Linearised:
        """The equations at ``state``."""

    def nearer(
        self,
        state: NewtonState,
        theta: jax.Array,
        equations: Linearised,
        move: jax.Array,
        fraction: jax.Array,
    ) -> jax.Array:
        """Whether ``fraction`` of the step ``move`` (n, 3) leads nearer to the saddle, shape ()."""

    def advance(self, iterates: Any, eliminated: Any, move: jax.Array, fraction: jax.Array) -> Any:
        """``iterates`` after ``fraction`` of a step by ``move`` (n, 3) mm."""
