"""Tetrahedral meshes with named node and facet sets, and the local numbering of a tetrahedron.

Linear elements have four corners; quadratic ones add a node on each edge, in VTK's order. A
:class:`Mesh` is checked once, when it is made, and frozen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skfem import MeshTet

from emulator.core.errors import InputError

_COINCIDENT = 1e-9  # of the body's extent, below which nodes are at the same place

# Edge k of a tetrahedron carries its local node 4 + k, side k of a triangle its local node 3 + k.
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
SIDES = ((0, 1), (1, 2), (2, 0))
# Faces of a positively oriented tetrahedron, normals pointing out: corners, then nodes on sides.
FACES = ((1, 2, 3, 5, 9, 8), (0, 3, 2, 7, 9, 6), (0, 1, 3, 4, 8, 7), (0, 2, 1, 6, 5, 4))
_SWAPPED = (0, 1, 3, 2, 4, 8, 7, 6, 5, 9)  # its nodes with corners 2 and 3 swapped


def signed_volumes(nodes: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Return the signed volume (m,) mm3 of each tetrahedron's corners, negative when inverted."""
    corner = nodes[elements[:, :4]]
    a, b, c = (corner[:, k] - corner[:, 0] for k in (1, 2, 3))
    return np.einsum("mi,mi->m", a, np.cross(b, c)) / 6.0


def cross_sides(corners: np.ndarray) -> np.ndarray:
    """Return normals (k, 3) of facets ``corners`` (k, 3 or 6, 3), as long as twice their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def orient(nodes: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Return ``elements`` (m, 4 or 10), corners 2 and 3 swapped where the volume is negative."""
    elements = np.array(elements, dtype=np.int64)
    inverted = signed_volumes(nodes, elements) < 0.0
    elements[inverted] = elements[inverted][:, _SWAPPED[: elements.shape[1]]]
    return elements


def faces_of(elements: np.ndarray) -> np.ndarray:
    """Return the four faces (4 m, 3 or 6) of oriented tetrahedra: all first ones, then the next."""
    width = 3 if elements.shape[1] == 4 else 6
    return np.concatenate([elements[:, face[:width]] for face in FACES])


def unshared(rows: np.ndarray, corners: int) -> np.ndarray:
    """Return the ``rows`` (k, w) whose first ``corners`` nodes are those of no other row."""
    _, first, counts = np.unique(
        np.sort(rows[:, :corners], axis=1), axis=0, return_index=True, return_counts=True
    )
    return rows[first[counts == 1]]


def find_rows(rows: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return the place (k,) in ``table`` (t, w) of the same nodes in any order, -1 for none."""
    places = {tuple(row): k for k, row in enumerate(np.sort(table, axis=1).tolist())}
    return np.array([places.get(tuple(row), -1) for row in np.sort(rows, axis=1).tolist()], int)


def boundary_facets(elements: np.ndarray) -> np.ndarray:
    """Return the surface triangles (k, 3 or 6) of oriented tetrahedra, normals pointing out.

    Quadratic ones list their corners, then the midpoints of edges 01, 12 and 20.
    """
    return unshared(faces_of(elements), 3)


def folded(elements: np.ndarray) -> np.ndarray:
    """Return pairs (k, 2) of oriented tetrahedra on the same side of a common face.

    Neighbours list their common face in opposite senses. Where a mesh is tangled they do not,
    though every element has a positive volume. Of three at one face, two are on the same side.
    """
    faces = faces_of(elements[:, :4])
    owner = np.tile(np.arange(len(elements)), len(FACES))
    a, b, c = faces.T
    sense = (a < b) ^ (b < c) ^ (a < c)  # of the permutation that sorts the corners
    keys = np.column_stack([np.sort(faces, axis=1), sense])
    order = np.lexsort(keys.T)
    same = (keys[order][1:] == keys[order][:-1]).all(axis=1)
    return np.column_stack([owner[order][:-1][same], owner[order][1:][same]])


def parts(elements: np.ndarray, nodes: int) -> np.ndarray:
    """Return the number (n,), from 0, of the connected part of each of the ``nodes``."""
    first, neighbours = np.repeat(elements[:, 0], elements.shape[1] - 1), elements[:, 1:].ravel()
    graph = coo_array((np.ones(len(first)), (first, neighbours)), shape=(nodes, nodes))
    return connected_components(graph, directed=False)[1]


def coincident(nodes: np.ndarray) -> np.ndarray:
    """Return pairs (k, 2) of ``nodes`` at the same place: elements touch there, not joined."""
    tolerance = _COINCIDENT * np.ptp(nodes, axis=0).max()
    return cKDTree(nodes).query_pairs(tolerance, output_type="ndarray")


# A tetrahedron is taken for flat when its volume is below this fraction of its longest edge cubed;
# a well-shaped one has about 0.1. Round-off in the corner coordinates is many orders smaller.
_FLAT = 1e-10


def indices(values: object, what: str) -> np.ndarray:
    """Return ``values`` as frozen whole numbers; :class:`InputError` where one has a fraction."""
    array = np.asarray(values)
    if array.dtype.kind == "f" and not (array == np.floor(array)).all():
        raise InputError(f"mesh: {what} has numbers with a fraction; give node indices")
    return frozen_array(array, np.int64)


def frozen_array(values: object, dtype: type = float) -> np.ndarray:
    """Return a read-only copy of ``values``: a function compiled from it stays valid."""
    array: np.ndarray = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Mesh:
    """Tetrahedra, linear or quadratic; displacements live on all its nodes.

    Parameters
    ----------
    nodes : the reference coordinates (n, 3), mm.
    elements : (m, 4) corner indices, positively oriented; (m, 10) adds a node on each edge, in
        VTK's order (01, 12, 02, 03, 13, 23).
    node_sets : name -> (k,) node indices.
    facet_sets : name -> (k, 3) corner indices of surface triangles; (k, 6) on a quadratic mesh,
        with the nodes on edges 01, 12 and 20. They are turned to face out of the tissue, whichever
        way they are listed.

    Raises
    ------
    InputError
        Wrong shapes, indices out of range, NaN, an inverted or a flat element, elements folded over
        each other, an unused node.
    """

    nodes: np.ndarray
    elements: np.ndarray
    node_sets: Mapping[str, np.ndarray] = field(default_factory=dict)
    facet_sets: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", frozen_array(self.nodes))
        object.__setattr__(self, "elements", indices(self.elements, "elements"))
        for field_name, kind in (("node_sets", "node set"), ("facet_sets", "facet set")):
            sets = {n: indices(x, f"{kind} '{n}'") for n, x in getattr(self, field_name).items()}
            object.__setattr__(self, field_name, MappingProxyType(sets))
        self._check_shapes()
        self._check_volumes()
        self._check_facets()

    def _check_shapes(self) -> None:
        if self.nodes.shape[1:] != (3,):
            raise InputError(f"mesh: nodes have shape {self.nodes.shape}; expected (n, 3)")
        if self.elements.shape[1:] not in ((4,), (10,)) or not self.elements.size:
            raise InputError(
                f"mesh: elements have shape {self.elements.shape}; expected (m, 4) or (m, 10)"
            )
        if not np.isfinite(self.nodes).all():
            bad = int(np.flatnonzero(~np.isfinite(self.nodes).all(axis=1))[0])
            raise InputError(f"mesh: node {bad} has a coordinate that is not finite")
        rows = np.unique(self.elements)
        if rows[0] < 0 or rows[-1] >= len(self.nodes):
            raise InputError(
                f"mesh: elements name nodes {rows[0]}..{rows[-1]}, but there are {len(self.nodes)}"
            )
        if len(rows) < len(self.nodes):
            loose = int(np.setdiff1d(np.arange(len(self.nodes)), rows)[0])
            raise InputError(f"mesh: node {loose} belongs to no element; remove it")
        for name, nodes in self.node_sets.items():
            if nodes.size == 0 or nodes.min() < 0 or nodes.max() >= len(self.nodes):
                raise InputError(f"mesh: node set '{name}' is empty or names a missing node")

    def _check_volumes(self) -> None:
        volumes = signed_volumes(self.nodes, self.elements)
        corner = self.nodes[self.corners]
        longest = np.max(np.linalg.norm(corner[:, :, None] - corner[:, None, :], axis=-1), (1, 2))
        flat = np.abs(volumes) <= _FLAT * longest**3
        for wrong, word in ((flat, "no volume"), (volumes < 0.0, "a negative volume (inverted)")):
            if wrong.any():
                first = int(np.flatnonzero(wrong)[0])
                raise InputError(
                    f"mesh: element {first} has {word}, {int(wrong.sum())} such of "
                    f"{len(self.elements)}; repair the mesh or reorder its corners"
                )
        pairs = folded(self.elements)
        if len(pairs):
            one, other = np.sort(pairs[0])
            raise InputError(
                f"mesh: elements {one} and {other} lie on the same side of the face that they "
                f"share, {len(pairs)} such pairs: the mesh is tangled; repair it"
            )

    def _check_facets(self) -> None:
        width = 3 if self.order == 1 else 6
        outward = {}
        for name, facets in self.facet_sets.items():
            if facets.shape[1:] != (width,) or not len(facets):
                raise InputError(
                    f"mesh: facet set '{name}' has shape {facets.shape}; not (k, {width})"
                )
            places = find_rows(facets, self.surface)  # which lists each facing out
            if (places < 0).any():
                absent = np.sort(facets[places < 0][0]).tolist()
                raise InputError(f"mesh: facet {absent} of set '{name}' is not on the surface")
            outward[name] = frozen_array(self.surface[places], np.int64)
        object.__setattr__(self, "facet_sets", MappingProxyType(outward))

    @property
    def order(self) -> int:
        """1 for linear tetrahedra, 2 for quadratic ones."""
        return 1 if self.elements.shape[1] == 4 else 2

    def require_linear(self, user: str) -> None:
        """Raise :class:`InputError` on a quadratic mesh; the message names ``user``."""
        if self.order != 1:
            raise InputError(f"mesh: {user} needs linear tetrahedra; these are quadratic")

    @property
    def corners(self) -> np.ndarray:
        """Corner nodes of each element, (m, 4)."""
        return self.elements[:, :4]

    @cached_property
    def surface(self) -> np.ndarray:
        """Every triangle of the surface, (k, 3) or (k, 6), normals pointing out."""
        return boundary_facets(self.elements)

    @property
    def size(self) -> float:
        """Length of the bounding box's diagonal, mm."""
        return float(np.linalg.norm(np.ptp(self.nodes, axis=0)))

    def node_set(self, name: str) -> np.ndarray:
        """Return the nodes (k,) in set ``name``; :class:`InputError` lists the mesh's sets."""
        return _named(self.node_sets, "node set", name)

    def facet_set(self, name: str) -> np.ndarray:
        """Return the facets (k, 3 or 6) in set ``name``; :class:`InputError` lists the sets."""
        return _named(self.facet_sets, "facet set", name)

    def elements_behind(self, facets: np.ndarray) -> np.ndarray:
        """Return the element (k,) that each surface facet (k, 3 or 6) belongs to."""
        return find_rows(facets[:, :3], faces_of(self.corners)) % len(self.elements)

    def to_skfem(self) -> MeshTet:
        """Return a linear mesh for scikit-fem, whose elements keep the order of their corners."""
        self.require_linear("scikit-fem's MeshTet")
        return MeshTet(self.nodes.T.copy(), self.elements.T.copy(), sort_t=False)


def _named(sets: Mapping[str, np.ndarray], kind: str, name: str) -> np.ndarray:
    if name not in sets:
        known = ", ".join(sorted(sets)) or "none"
        raise InputError(f"{kind} '{name}' is not in the mesh; its sets: {known}")
    return sets[name]
