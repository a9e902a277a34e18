"""Prescribed displacements, and the count of rigid motions that supports leave free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from emulator.errors import InputError
from emulator.geometry.mesh import Mesh, frozen_array
from emulator.scenes.supports.boundary_condition import BoundaryCondition, Held, Resisted

_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Support(BoundaryCondition):
    """Displacement of a node set held at a value, in all its components or in some.

    Parameters
    ----------
    node_set : name of the set.
    displacement : (3,) or (k, 3) in mm, one row a node of the set; zero clamps it.
    components : which of ``xyz`` are held; the others stay free, whatever their ``displacement``.
    """

    kind: ClassVar[str] = "held"

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

    def held(self, mesh: Mesh) -> Held:
        """The nodes of the set, their displacements, and the axes that are held."""
        nodes = mesh.node_set(self.node_set)
        if not np.isfinite(self.displacement).all():
            raise InputError(f"support on '{self.node_set}': displacement is not finite")
        if self.displacement.shape not in ((3,), (len(nodes), 3)):
            raise InputError(
                f"support on '{self.node_set}': displacement has shape "
                f"{self.displacement.shape}; expected (3,) or ({len(nodes)}, 3)"
            )
        axes = [k for k, axis in enumerate(_AXES) if axis in self.components]
        return Held(self.node_set, nodes, np.broadcast_to(self.displacement, (len(nodes), 3)), axes)

    def on_finer(self, mesh: Mesh, moved: np.ndarray) -> Support:
        """Nodes between held ones move between them."""
        if self.displacement.ndim == 1:
            return self
        return replace(self, displacement=moved[mesh.node_set(self.node_set)])

    def resisted(self, mesh: Mesh) -> Resisted:
        """Every node of the set along each axis that is held."""
        _, nodes, _, axes = self.held(mesh)
        points = np.repeat(mesh.nodes[nodes], len(axes), axis=0)
        return Resisted(points, np.tile(np.eye(3)[axes], (len(nodes), 1)))


def prescribe(mesh: Mesh, supports: Sequence[BoundaryCondition]) -> tuple[np.ndarray, np.ndarray]:
    """``(held, values)``: where the displacement is known, (n, 3) bool, and its value, (n, 3) mm.

    Raises
    ------
    InputError
        Two supports hold a shared node at different values.
    """
    held = np.zeros(mesh.nodes.shape, dtype=bool)
    values = np.zeros(mesh.nodes.shape)
    for support in supports:
        if (prescribed := support.held(mesh)) is None:
            continue
        where, nodes, wanted, axes = prescribed
        for axis in axes:
            clash = held[nodes, axis] & (values[nodes, axis] != wanted[:, axis])
            if clash.any():
                node = nodes[np.flatnonzero(clash)[0]]
                raise InputError(
                    f"support on '{where}' contradicts another one at node {node}: "
                    f"{_AXES[axis]} is {values[node, axis]:g} mm there, "
                    f"not {wanted[np.flatnonzero(clash)[0], axis]:g}"
                )
            held[nodes, axis], values[nodes, axis] = True, wanted[:, axis]
    return frozen_array(held, bool), frozen_array(values)
