"""Supports that prescribe displacements, and whether a body is held at all."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from emulator.errors import InputError
from emulator.geometry.mesh import Mesh, frozen_array

_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Support:
    """Displacement of a node set held at a value, in all its components or in some.

    Parameters
    ----------
    node_set : name of the set.
    displacement : (3,) or (k, 3) in mm, one row a node of the set; zero clamps it.
    components : which of ``xyz`` are held; the others stay free, whatever their ``displacement``.
    """

    node_set: str
    displacement: np.ndarray = field(default_factory=lambda: np.zeros(3))
    components: str = _AXES

    def __post_init__(self) -> None:
        object.__setattr__(self, "displacement", frozen_array(self.displacement))
        if not self.components or set(self.components) - set(_AXES):
            raise InputError(
                f"support on '{self.node_set}': components '{self.components}'; "
                "name some of x, y and z"
            )

    def values(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray, list[int]]:
        """``(nodes, displacement, axes)``: what is held (k,), at what (k, 3), in which axes."""
        nodes = mesh.node_set(self.node_set)
        if not np.isfinite(self.displacement).all():
            raise InputError(f"support on '{self.node_set}': displacement is not finite")
        if self.displacement.shape not in ((3,), (len(nodes), 3)):
            raise InputError(
                f"support on '{self.node_set}': displacement has shape "
                f"{self.displacement.shape}; expected (3,) or ({len(nodes)}, 3)"
            )
        axes = [k for k, axis in enumerate(_AXES) if axis in self.components]
        return nodes, np.broadcast_to(self.displacement, (len(nodes), 3)), axes


def prescribe(mesh: Mesh, supports: list[Support]) -> tuple[np.ndarray, np.ndarray]:
    """``(held, values)``: where the displacement is known, (n, 3) bool, and it, (n, 3) mm.

    Raises
    ------
    InputError
        Two supports hold a shared node at different values.
    """
    held = np.zeros(mesh.nodes.shape, dtype=bool)
    values = np.zeros(mesh.nodes.shape)
    for support in supports:
        nodes, wanted, axes = support.values(mesh)
        for axis in axes:
            clash = held[nodes, axis] & (values[nodes, axis] != wanted[:, axis])
            if clash.any():
                node = nodes[np.flatnonzero(clash)[0]]
                raise InputError(
                    f"support on '{support.node_set}' contradicts another one at node {node}: "
                    f"{_AXES[axis]} is {values[node, axis]:g} mm there, "
                    f"not {wanted[np.flatnonzero(clash)[0], axis]:g}"
                )
            held[nodes, axis], values[nodes, axis] = True, wanted[:, axis]
    return frozen_array(held, bool), frozen_array(values)


def free_motions(points: np.ndarray, directions: np.ndarray) -> int:
    """How many of the six rigid motions remain.

    ``points`` (k, 3) cannot move along ``directions`` (k, 3). A small rigid motion ``a + w x X``
    moves a point along its direction by
    ``a . d + w . (X x d)``; the rank of those rows says how many motions are stopped.
    """
    if not len(points):
        return 6
    centred = points - points.mean(axis=0)
    size = np.linalg.norm(np.ptp(points, axis=0))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.hstack([unit, np.cross(centred, unit) / (size if size > 0.0 else 1.0)])
    return 6 - int(np.linalg.matrix_rank(rows.T @ rows, tol=1e-12 * len(rows), hermitian=True))
