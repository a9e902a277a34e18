r"""Prescribed displacements: fixed ones, and ones whose amount is a parameter.

.. math:: u = \bar u + \sum_k \theta_k\, d_k

at prescribed components, with the fixed displacement :math:`\bar u` in mm and the displacement
:math:`d_k` in mm per unit of the amount :math:`\theta_k`, such as the amount of shear of a cube
between plates. All supports of a scene together leave no rigid motion of the body free.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import ClassVar, override

import numpy as np
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, frozen_array, parts
from emulator.scenes.part import BoundaryCondition, Held, Prescribed

_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Support(BoundaryCondition):
    """Displacement of a node set held at a value, in all its components or in some.

    Parameters
    ----------
    node_set : name of the set.
    displacement : in mm, (3,), or in Python (k, 3), one row a node of the set; zero clamps it.
    components : which of ``xyz`` are held; the others stay free, whatever their ``displacement``.
    amount : name of a parameter, without a unit, that multiplies ``displacement``; without it, the
        displacement is fixed. A plate that moves by 10 mm times ``shear``, say, shears a cube of
        10 mm between it and another plate by ``shear``.
    """

    kind: ClassVar[str] = "held"

    node_set: str
    displacement: np.ndarray = field(default_factory=lambda: np.zeros(3))
    components: str = _AXES
    amount: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "displacement", frozen_array(self.displacement))
        if not self.components or set(self.components) - set(_AXES):
            raise InputError(
                f"support on '{self.node_set}': components '{self.components}'; "
                "name some of x, y and z"
            )

    @override
    def to_json(self) -> None:
        """Return nothing: :meth:`held` describes the support."""

    @override
    def held(self, mesh: Mesh) -> Held:
        nodes = mesh.node_set(self.node_set)
        if not np.isfinite(self.displacement).all():
            raise InputError(f"support on '{self.node_set}': displacement is not finite")
        if self.displacement.shape not in ((3,), (len(nodes), 3)):
            raise InputError(
                f"support on '{self.node_set}': displacement has shape "
                f"{self.displacement.shape}; expected (3,) or ({len(nodes)}, 3)"
            )
        axes = [k for k, axis in enumerate(_AXES) if axis in self.components]
        every = np.broadcast_to(self.displacement, (len(nodes), 3))
        return Held(self.node_set, nodes, every, axes, self.amount)

    @override
    def on_finer(self, mesh: Mesh, displacements: Mapping[str | None, np.ndarray]) -> Support:
        if self.displacement.ndim == 1:
            return self
        return replace(self, displacement=displacements[self.amount][mesh.node_set(self.node_set)])

    @override
    def resisted(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
        _, nodes, _, axes, _ = self.held(mesh)
        points = np.repeat(mesh.nodes[nodes], len(axes), axis=0)
        return points, np.tile(np.eye(3)[axes], (len(nodes), 1))


def prescribe(mesh: Mesh, supports: Sequence[BoundaryCondition]) -> Prescribed:
    """Return the displacements that all ``supports`` prescribe.

    Raises
    ------
    InputError
        Two supports prescribe different values at a node that they share.
    """
    components = np.zeros(mesh.nodes.shape, dtype=bool)
    prescribed = [held for support in supports if (held := support.held(mesh)) is not None]
    amounts = (None, *dict.fromkeys(held.amount for held in prescribed if held.amount))
    totals = {amount: np.zeros(mesh.nodes.shape) for amount in amounts}
    for where, nodes, displacement, axes, parameter in prescribed:
        for axis in axes:
            for amount, total in totals.items():
                value = displacement[:, axis] if amount == parameter else np.zeros(len(nodes))
                clash = np.flatnonzero(components[nodes, axis] & (total[nodes, axis] != value))
                if len(clash):
                    node, times = nodes[clash[0]], f" times {amount}" if amount else ""
                    raise InputError(
                        f"support on '{where}' contradicts another one at node {node}: "
                        f"{_AXES[axis]} is {total[node, axis]:g} mm{times} there, "
                        f"not {value[clash[0]]:g}"
                    )
                total[nodes, axis] = value
            components[nodes, axis] = True
    fixed = frozen_array(totals.pop(None))
    per_unit = {str(name): frozen_array(total) for name, total in totals.items() if total.any()}
    return Prescribed(frozen_array(components, bool), fixed, MappingProxyType(per_unit))


def loose_parts(
    mesh: Mesh, supports: Sequence[BoundaryCondition]
) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the nodes of each connected part that can move or turn, and its free rigid motions."""
    none = np.empty((0, 3))
    resisted = [(none, none), *(support.resisted(mesh) for support in supports)]
    points, directions = map(np.concatenate, zip(*resisted, strict=True))
    part = parts(mesh.elements, len(mesh.nodes))
    owner = part[cKDTree(mesh.nodes).query(points)[1]]
    for k in range(part.max() + 1):
        if free := _free_motions(points[owner == k], directions[owner == k]):
            yield np.flatnonzero(part == k), free


def check_motions(mesh: Mesh, supports: Sequence[BoundaryCondition]) -> None:
    """Refuse supports that let a connected part of the body move or turn."""
    if not supports:
        raise InputError("no support, the body could move freely")
    for nodes, free in loose_parts(mesh, supports):
        who = "its supports leave"
        if len(nodes) < len(mesh.nodes):
            x, y, z = mesh.nodes[nodes].mean(axis=0)
            count = parts(mesh.elements, len(mesh.nodes)).max() + 1
            who = (
                f"the mesh has {count} parts, and supports leave the one of "
                f"{len(nodes)} nodes about ({x:.3g}, {y:.3g}, {z:.3g}) mm"
            )
        raise InputError(
            f"{who} {free} of the 6 rigid motions free, the body could move "
            "or turn; hold more nodes or components"
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
