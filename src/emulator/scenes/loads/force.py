r"""A dead force on a point, an edge or a set of nodes.

Potential :math:`-F \cdot \sum_a w_a u_a` with weights that add up to 1: the shares of the nodes in
the length of the mesh's edges between them, so that a force on an edge is spread evenly along it,
and equal ones where no two nodes share an edge. Under a point, strains grow without bound as the
mesh is refined; resultants and displacements elsewhere do not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, override

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import EDGES, Mesh, frozen_array
from emulator.scenes.part import Load, LocalForce, Prescribed, Values
from emulator.scenes.tissue import Fibres

MN_PER_N = 1e3


@dataclass(frozen=True, eq=False)
class Force(Load):
    """A force in N that keeps its direction, spread over a node set.

    Parameters
    ----------
    node_set : one node, the nodes of an edge, or any others.
    resultant : three components in N, or in Python (k, 3), one row a node of the set; with
        ``amount``, per unit of that parameter.
    amount : name of a parameter that multiplies the force; without it, the force is known. A range
        around 1 makes it a force known to some percent.
    """

    kind: ClassVar[str] = "force"

    node_set: str
    resultant: np.ndarray
    amount: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "resultant", force := frozen_array(self.resultant))
        if force.shape[-1:] != (3,) or force.ndim > 2 or not np.isfinite(force).all():
            raise InputError(
                f"force on '{self.node_set}' is {force.tolist()}; give 3 finite numbers in N"
            )

    @property
    def simpler(self) -> tuple[str, None]:
        """No force."""
        return f"force on '{self.node_set}'", None

    @override
    def check(self, mesh: Mesh, prescribed: Prescribed) -> None:
        count = len(mesh.node_set(self.node_set))
        if self.resultant.ndim == 2 and len(self.resultant) != count:
            raise InputError(
                f"force on '{self.node_set}' has {len(self.resultant)} rows for {count} nodes"
            )

    @override
    def dead_forces(self, grid: Discretisation) -> Mapping[str | None, np.ndarray]:
        return {self.amount: self._spread(grid.mesh)}

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        mesh, amount = grid.mesh, self.amount
        nodes = mesh.node_set(self.node_set)
        if len(edges_between(mesh, nodes)):
            raise InputError(
                f"force on '{self.node_set}' is spread along an edge by its length at rest, which "
                "is what unloading looks for; give the force to nodes that no edge joins"
            )
        share = self._spread(mesh)[nodes][:, None]

        def force(_: jax.Array, share: jax.Array, values: Values) -> jax.Array:
            return share if amount is None else values[amount] * share

        return (LocalForce(nodes[:, None], share, force),)

    def _spread(self, mesh: Mesh) -> np.ndarray:
        nodes = mesh.node_set(self.node_set)
        if self.resultant.ndim == 1:
            return MN_PER_N * shares(mesh, nodes)[:, None] * self.resultant
        forces = np.zeros(mesh.nodes.shape)
        forces[nodes] = MN_PER_N * self.resultant
        return forces


def edges_between(mesh: Mesh, nodes: np.ndarray) -> np.ndarray:
    """Return the edges (e, 2), quadratic (e, 3), whose nodes are all among ``nodes`` (k,)."""
    among = np.zeros(len(mesh.nodes), dtype=bool)
    among[nodes] = True
    local = [(a, b, 4 + k)[: mesh.order + 1] for k, (a, b) in enumerate(EDGES)]
    edges = mesh.elements[:, local].reshape(-1, mesh.order + 1)
    edges = edges[among[edges].all(axis=1)]
    edges[:, :2] = np.sort(edges[:, :2], axis=1)
    return np.unique(edges, axis=0)


def shares(mesh: Mesh, nodes: np.ndarray) -> np.ndarray:
    """Return weights (n,) of sum 1 on ``nodes`` (k,), by the length of mesh edges between them.

    Weights of a quadratic edge are Simpson's: a sixth at each end and two thirds in the middle.
    """
    edges = edges_between(mesh, nodes)
    weights = np.zeros(len(mesh.nodes))
    if not len(edges):
        weights[nodes] = 1.0 / len(nodes)
        return weights
    length = np.linalg.norm(mesh.nodes[edges[:, 1]] - mesh.nodes[edges[:, 0]], axis=1)
    simpson = (1 / 6, 1 / 6, 2 / 3) if mesh.order == 2 else (0.5, 0.5)
    for column, weight in zip(edges.T, simpson, strict=True):
        np.add.at(weights, column, weight * length)
    return weights / weights.sum()
