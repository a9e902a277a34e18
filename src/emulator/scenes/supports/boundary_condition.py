"""The interface every support implements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.local_terms import LocalForce, LocalTerm


class Held(NamedTuple):
    """Prescribed displacements.

    where : name for error messages. nodes : (k,). displacement : (k, 3) mm. axes : held ones.
    amount : parameter that the displacement is multiplied by, or None.
    """

    where: str
    nodes: np.ndarray
    displacement: np.ndarray
    axes: list[int]
    amount: str | None = None


class Resisted(NamedTuple):
    """``points`` (k, 3) in mm and the ``directions`` (k, 3) in which they cannot move freely."""

    points: np.ndarray
    directions: np.ndarray


class BoundaryCondition(ABC):
    """A support: it prescribes displacements, or resists them with springs.

    kind : name in scene files and in :data:`~emulator.scenes.supports.SUPPORTS`.
    """

    kind: ClassVar[str]

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """Facet sets the support acts on; they must be in the mesh."""
        return ()

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Parameters the support takes from theta or from the scene's constants."""
        return ()

    @property
    def simpler(self) -> tuple[str, BoundaryCondition | None] | None:
        """An effect that can be left out: its name, and the support without it, None for none."""
        return None

    def held(self, mesh: Mesh) -> Held | None:
        """Prescribed displacements, or None."""
        return None

    def term(self, grid: Discretisation) -> LocalTerm | None:
        """Potential of its springs, or None."""
        return None

    def on_loaded(self, grid: Discretisation) -> LocalForce | None:
        """Force of its springs on the body whose *loaded* shape is the mesh, of w to rest; or None.

        See :meth:`emulator.scenes.loads.load.Load.on_loaded`.
        """
        return None

    def on_finer(self, mesh: Mesh, moved: Mapping[str | None, np.ndarray]) -> BoundaryCondition:
        """The support on a finer ``mesh``.

        ``moved`` : displacement (f, 3) mm of its held nodes, the fixed one under None, and per unit
        of each amount under the amount's name.
        """
        del mesh, moved
        return self

    @abstractmethod
    def resisted(self, mesh: Mesh) -> Resisted:
        """Points, and directions at them, in which a rigid motion of the body is resisted."""

    def to_json(self) -> list[Any] | None:
        """Plain JSON that identifies the springs; None where :meth:`held` describes the support."""
        return None
