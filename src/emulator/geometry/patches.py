r"""Patches of neighbouring linear tetrahedra that share one volume change.

A mesh has five or six tetrahedra a node. Nearly incompressible, each is a constraint on volume, and
three displacements a node cannot meet them all: linear elements lock. With patches :math:`P` of
about six, which do not overlap,

.. math::
    \hat F_e = \left(\bar J_P / J_e\right)^{1/3} F_e, \qquad
    \bar J_P = \frac{\sum_{e \in P} V_e J_e}{\sum_{e \in P} V_e},

there is about one constraint a node (de Souza Neto, Andrade Pires & Owen 2005, Int. J. Numer.
Meth. Engng 62, 353-383). Here W at :math:`\hat F` is one energy, as with mean dilatation.

Patches depend on the mesh's connections only, not on the order in which its elements are listed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from emulator.geometry.discretisation import Blocks, Discretisation
from emulator.geometry.mesh import FACES, Mesh, frozen_array

_SIZE = 6  # tetrahedra in a patch; the cavity of a ventricle grows as much with 8 or 12
_LEAST = 3  # least elements of a patch; smaller remainders join a neighbour


@dataclass(frozen=True, eq=False)
class Patches(Blocks):
    """Patches as blocks, a point for each tetrahedron.

    Smaller patches than the largest repeat a node with gradients of zero, and a tetrahedron with a
    weight of zero.

    members : the element (b, q) at each point.
    """

    members: np.ndarray

    def gather[A: (jax.Array, np.ndarray)](self, field: A) -> A:
        """Return the values (b, q, ...) at the patches' points of a ``field`` (m, 1, ...)."""
        return field[self.members, 0]


def patchwise(grid: Discretisation, size: int = _SIZE) -> Patches:
    """Return the linear elements of ``grid`` in :func:`patches` of ``size``."""
    label = patches(grid.mesh, size)
    members, real = _rows(label, np.arange(len(label)))
    keys, columns = np.unique(
        label[:, None] * len(grid.mesh.nodes) + grid.connectivity, return_inverse=True
    )
    owner, node = np.divmod(keys, len(grid.mesh.nodes))
    connectivity, _ = _rows(owner, node)
    column = np.arange(len(keys)) - np.searchsorted(owner, owner)
    # Each element's gradients at the columns of its patch.
    wide = np.zeros((len(label), connectivity.shape[1], 3))
    wide[np.arange(len(label))[:, None], column[columns.reshape(-1, 4)]] = grid.gradients[:, 0]
    return Patches(
        connectivity=frozen_array(connectivity, int),
        gradients=frozen_array(wide[members]),
        weights=frozen_array(np.where(real, grid.weights[members, 0], 0.0)),
        members=frozen_array(members, int),
    )


def _rows(label: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of each label as a row, filled with its first, and which are no fill."""
    order = np.argsort(label, kind="stable")
    counts = np.bincount(label)
    first = np.cumsum(counts) - counts
    column = np.arange(counts.max())
    real = column < counts[:, None]
    return values[order[first[:, None] + np.where(real, column, 0)]], real


def patches(mesh: Mesh, size: int = _SIZE) -> np.ndarray:
    """Return the patch of each linear tetrahedron, (m,) from 0 up.

    A patch grows from the first tetrahedron that is in none, over faces, to ``size``; small
    remainders join their smallest neighbour, because isolated elements would lock.
    """
    corners = np.sort(mesh.corners, axis=1)
    order = np.lexsort(corners.T)
    neighbours = _neighbours(corners[order])
    groups = _join_small(_grow(corners[order].tolist(), neighbours, size), neighbours)
    label = np.empty(len(order), dtype=int)
    for k, group in enumerate(groups):
        label[order[group]] = k
    return label


def _neighbours(corners: np.ndarray) -> list[list[int]]:
    """Return the elements across the faces of each element, from sorted ``corners`` (m, 4)."""
    faces = np.concatenate([np.sort(corners[:, face], axis=1) for face in FACES])
    order = np.lexsort(faces.T)
    same = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(axis=1))
    neighbours: list[list[int]] = [[] for _ in corners]
    ends = np.stack([order[same], order[same + 1]]) % len(corners)
    for one, other in ends.T.tolist():
        neighbours[one].append(other)
        neighbours[other].append(one)
    return neighbours


def _grow(
    corners: Sequence[list[int]], neighbours: Sequence[list[int]], size: int
) -> list[list[int]]:
    """Return the elements of each patch, grown over faces to at most ``size``."""
    assigned, groups = [False] * len(corners), []

    def order(k: int, nodes: set[int]) -> tuple[int, int, int]:
        # Prefer compact patches, then elements with few free neighbours.
        return len(nodes.union(corners[k])), sum(not assigned[j] for j in neighbours[k]), k

    for seed in range(len(corners)):
        group: list[int] = []
        nodes: set[int] = set()
        edge = set() if assigned[seed] else {seed}
        while edge and len(group) < size:
            best = min(edge, key=lambda k: order(k, nodes))
            group.append(best)
            assigned[best] = True
            nodes.update(corners[best])
            edge = {k for k in edge.union(neighbours[best]) if not assigned[k]}
        if group:
            groups.append(group)
    return groups


def _join_small(groups: list[list[int]], neighbours: Sequence[list[int]]) -> list[list[int]]:
    """Join each patch below ``_LEAST`` elements to its smallest neighbour; return the patches."""
    owner = {k: patch for patch, group in enumerate(groups) for k in group}
    for patch, group in enumerate(groups):
        adjacent = {owner[j] for k in group for j in neighbours[k]} - {patch}
        if len(group) < _LEAST and adjacent:
            neighbour = min(adjacent, key=lambda other: (len(groups[other]), other))
            groups[neighbour] += group
            owner |= dict.fromkeys(group, neighbour)
            groups[patch] = []
    return [group for group in groups if group]
