"""The interface of supports, and the rigid motions that they leave to a body."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh, parts
from emulator.scenes.part import LocalForce, LocalTerm, Part


class Held(NamedTuple):
    """Prescribed displacements of one support.

    where : the name of the node set, for error messages.
    nodes : the nodes (k,) of the set.
    displacement : the displacement, (k, 3) mm; with ``amount``, per unit of that parameter.
    axes : the numbers of the prescribed components.
    amount : the name of the parameter that multiplies the displacement, or None.
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


@dataclass(frozen=True, eq=False)
class BoundaryCondition(Part):
    """A part that prescribes displacements, or resists them with springs."""

    def held(self, mesh: Mesh) -> Held | None:
        """Return prescribed displacements, or None."""
        return None

    def term(self, grid: Discretisation) -> LocalTerm | None:
        """Return the potential of the springs, or None."""
        return None

    def on_loaded(self, grid: Discretisation) -> LocalForce | None:
        """Return the force of the springs on a body whose *loaded* shape is the mesh, or None.

        See :meth:`emulator.scenes.loads.load.Load.on_loaded`.
        """
        return None

    def on_finer(
        self, mesh: Mesh, displacements: Mapping[str | None, np.ndarray]
    ) -> BoundaryCondition:
        """Return the support on a finer mesh.

        Parameters
        ----------
        mesh : the finer mesh.
        displacements : (f, 3) mm at its nodes, the fixed one under None, and one per unit of each
            parameter under the parameter's name.
        """
        return self

    @abstractmethod
    def resisted(self, mesh: Mesh) -> Resisted:
        """Return points, and directions in which a rigid motion of the body is resisted there."""


def check_motions(mesh: Mesh, supports: Sequence[BoundaryCondition]) -> None:
    """Refuse supports that let a connected part of the body move or turn."""
    resisted = [support.resisted(mesh) for support in supports]
    points = np.concatenate([each.points for each in resisted])
    directions = np.concatenate([each.directions for each in resisted])
    part = parts(mesh.elements, len(mesh.nodes))
    owner = part[cKDTree(mesh.nodes).query(points)[1]]
    for k in range(part.max() + 1):
        free = _free_motions(points[owner == k], directions[owner == k])
        if free:
            description = (
                _part_in_words(mesh.nodes, part, k) if part.any() else "its supports leave"
            )
            raise InputError(
                f"{description} {free} of the 6 rigid motions free, the body could move "
                "or turn; hold more nodes or components"
            )


def _part_in_words(nodes: np.ndarray, part: np.ndarray, k: int) -> str:
    inside = nodes[part == k]
    x, y, z = inside.mean(axis=0)
    return (
        f"the mesh has {part.max() + 1} parts, and supports leave the one of {len(inside)} nodes "
        f"about ({x:.3g}, {y:.3g}, {z:.3g}) mm"
    )


def _free_motions(points: np.ndarray, directions: np.ndarray) -> int:
    """Return how many rigid motions ``points`` (k, 3), fixed along ``directions`` (k, 3), leave.

    A small rigid motion ``a + w x X`` moves a point along its direction by ``a . d + w . (X x d)``;
    the rank of these rows is the number of motions that are resisted.
    """
    if not len(points):
        return 6
    centred = points - points.mean(axis=0)
    size = np.linalg.norm(np.ptp(points, axis=0))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.hstack([unit, np.cross(centred, unit) / (size if size > 0.0 else 1.0)])
    return 6 - int(np.linalg.matrix_rank(rows.T @ rows, tol=1e-12 * len(rows), hermitian=True))
