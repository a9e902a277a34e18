"""Tetrahedral mesh with named node sets, checked once when it is made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from types import MappingProxyType

import numpy as np
from skfem import MeshTet

from emulator.errors import InputError

# A tetrahedron is taken for flat when its volume is below this fraction of its longest edge cubed;
# a well-shaped one has about 0.1. Round-off in the corner coordinates is many orders smaller.
_FLAT = 1e-10


def frozen_array(values: object, dtype: type = float) -> np.ndarray:
    """A read-only copy of ``values``, so that what holds it cannot change under a trace."""
    array: np.ndarray = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array


def signed_volumes(nodes: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Signed volume of each tetrahedron in mm3, shape (m,); negative when inverted."""
    corner = nodes[elements]
    a, b, c = (corner[:, k] - corner[:, 0] for k in (1, 2, 3))
    return np.einsum("mi,mi->m", a, np.cross(b, c)) / 6.0


def orient(nodes: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """``elements`` with two corners swapped wherever the volume is negative, shape (m, 4)."""
    elements = np.array(elements, dtype=np.int64)
    inverted = signed_volumes(nodes, elements) < 0.0
    elements[inverted, 2], elements[inverted, 3] = elements[inverted, 3], elements[inverted, 2]
    return elements


def boundary_facets(elements: np.ndarray) -> np.ndarray:
    """Surface triangles (k, 3) of positively oriented tetrahedra, their normals pointing out."""
    faces = np.concatenate(
        [elements[:, face] for face in ([1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1])]
    )
    _, first, counts = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return faces[first[counts == 1]]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Linear tetrahedra.

    Parameters
    ----------
    nodes : (n, 3) reference coordinates, mm.
    elements : (m, 4) corner indices, positively oriented.
    node_sets : name -> (k,) node indices.
    facet_sets : name -> (k, 3) corner indices of surface triangles.

    Raises
    ------
    InputError
        Wrong shapes, indices out of range, NaN, an inverted or a flat element, an unused node.
    """

    nodes: np.ndarray
    elements: np.ndarray
    node_sets: Mapping[str, np.ndarray] = field(default_factory=dict)
    facet_sets: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", frozen_array(self.nodes))
        object.__setattr__(self, "elements", frozen_array(self.elements, np.int64))
        sets = {name: frozen_array(nodes, np.int64) for name, nodes in self.node_sets.items()}
        object.__setattr__(self, "node_sets", MappingProxyType(sets))
        facets = {name: frozen_array(rows, np.int64) for name, rows in self.facet_sets.items()}
        object.__setattr__(self, "facet_sets", MappingProxyType(facets))
        self._check_shapes()
        self._check_volumes()
        self._check_facets()

    def _check_shapes(self) -> None:
        if self.nodes.ndim != 2 or self.nodes.shape[1] != 3:
            raise InputError(f"mesh: nodes have shape {self.nodes.shape}; expected (n, 3)")
        if self.elements.ndim != 2 or self.elements.shape[1] != 4 or not len(self.elements):
            raise InputError(f"mesh: elements have shape {self.elements.shape}; expected (m, 4)")
        if not np.isfinite(self.nodes).all():
            bad = int(np.flatnonzero(~np.isfinite(self.nodes).all(axis=1))[0])
            raise InputError(f"mesh: node {bad} has a coordinate that is not finite")
        used = np.unique(self.elements)
        if used[0] < 0 or used[-1] >= len(self.nodes):
            raise InputError(
                f"mesh: elements name nodes {used[0]}..{used[-1]}, but there are {len(self.nodes)}"
            )
        if len(used) < len(self.nodes):
            loose = int(np.setdiff1d(np.arange(len(self.nodes)), used)[0])
            raise InputError(f"mesh: node {loose} belongs to no element; remove it")
        for name, nodes in self.node_sets.items():
            if nodes.size == 0 or nodes.min() < 0 or nodes.max() >= len(self.nodes):
                raise InputError(f"mesh: node set '{name}' is empty or names a missing node")

    def _check_volumes(self) -> None:
        volumes = signed_volumes(self.nodes, self.elements)
        corner = self.nodes[self.elements]
        longest = np.max(np.linalg.norm(corner[:, :, None] - corner[:, None, :], axis=-1), (1, 2))
        flat = np.abs(volumes) <= _FLAT * longest**3
        for wrong, word in ((flat, "no volume"), (volumes < 0.0, "a negative volume (inverted)")):
            if wrong.any():
                first = int(np.flatnonzero(wrong)[0])
                raise InputError(
                    f"mesh: element {first} has {word}, {int(wrong.sum())} such of "
                    f"{len(self.elements)}; repair the mesh or reorder its corners"
                )

    def _check_facets(self) -> None:
        if not self.facet_sets:
            return
        surface = {tuple(row) for row in np.sort(boundary_facets(self.elements), axis=1).tolist()}
        for name, facets in self.facet_sets.items():
            if facets.ndim != 2 or facets.shape[1:] != (3,) or not len(facets):
                raise InputError(f"mesh: facet set '{name}' has shape {facets.shape}; not (k, 3)")
            for row in np.sort(facets, axis=1).tolist():
                if tuple(row) not in surface:
                    raise InputError(f"mesh: facet {row} of set '{name}' is not on the surface")

    @property
    def size(self) -> float:
        """Length of the bounding box's diagonal, mm."""
        return float(np.linalg.norm(np.ptp(self.nodes, axis=0)))

    def node_set(self, name: str) -> np.ndarray:
        """Indices of the nodes in set ``name``; :class:`InputError` lists the sets there are."""
        if name not in self.node_sets:
            known = ", ".join(sorted(self.node_sets)) or "none"
            raise InputError(f"node set '{name}' is not in the mesh; its sets: {known}")
        return self.node_sets[name]

    def facet_set(self, name: str) -> np.ndarray:
        """Corners (k, 3) of the facets in set ``name``; :class:`InputError` lists the sets."""
        if name not in self.facet_sets:
            known = ", ".join(sorted(self.facet_sets)) or "none"
            raise InputError(f"facet set '{name}' is not in the mesh; its sets: {known}")
        return self.facet_sets[name]

    def elements_behind(self, facets: np.ndarray) -> np.ndarray:
        """The element (k,) each surface facet (k, 3) belongs to."""
        owner: dict[tuple[int, ...], int] = {}
        for corners in combinations(range(4), 3):
            for k, row in enumerate(np.sort(self.elements[:, corners], axis=1).tolist()):
                owner[tuple(row)] = k
        return np.array([owner[tuple(row)] for row in np.sort(facets, axis=1).tolist()])

    def to_skfem(self) -> MeshTet:
        """The same mesh for scikit-fem (corner order kept, hence no sorting)."""
        return MeshTet(self.nodes.T.copy(), self.elements.T.copy(), sort_t=False)
