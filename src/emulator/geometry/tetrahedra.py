"""Local numbering of a tetrahedron; signed volumes, orientation, boundary facets, parts.

Linear elements have four corners. Quadratic ones add a node on each edge, in VTK's order.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_COINCIDENT = 1e-9  # of the body's extent, below which nodes are at the same place

# Edge k carries local node 4 + k of a quadratic element.
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
# Faces of a positively oriented tetrahedron, normals pointing out.
FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))


def _with_midpoints(face: tuple[int, ...]) -> tuple[int, ...]:
    """Local nodes of a quadratic face: its corners, then the midpoints of 01, 12 and 20."""
    pairs = [(face[k], face[(k + 1) % 3]) for k in range(3)]
    return face + tuple(4 + EDGES.index((min(pair), max(pair))) for pair in pairs)


QUADRATIC_FACES = tuple(_with_midpoints(face) for face in FACES)


def signed_volumes(nodes: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Signed volume of each tetrahedron's corners in mm3, shape (m,); negative when inverted."""
    corner = nodes[elements[:, :4]]
    a, b, c = (corner[:, k] - corner[:, 0] for k in (1, 2, 3))
    return np.einsum("mi,mi->m", a, np.cross(b, c)) / 6.0


def orient(nodes: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """``elements`` (m, 4 or 10), corners 2 and 3 swapped wherever the volume is negative."""
    elements = np.array(elements, dtype=np.int64)
    swapped = [0, 1, 3, 2]
    if elements.shape[1] == 10:
        ends = [(swapped[a], swapped[b]) for a, b in EDGES]
        swapped += [4 + EDGES.index((min(pair), max(pair))) for pair in ends]
    inverted = signed_volumes(nodes, elements) < 0.0
    elements[inverted] = elements[inverted][:, swapped]
    return elements


def boundary_facets(elements: np.ndarray) -> np.ndarray:
    """Surface triangles (k, 3 or 6) of positively oriented tetrahedra, their normals pointing out.

    Quadratic ones list their corners, then the midpoints of edges 01, 12 and 20.
    """
    local = FACES if elements.shape[1] == 4 else QUADRATIC_FACES
    faces = np.concatenate([elements[:, face] for face in local])
    _, first, counts = np.unique(
        np.sort(faces[:, :3], axis=1), axis=0, return_index=True, return_counts=True
    )
    return faces[first[counts == 1]]


def folded(elements: np.ndarray) -> np.ndarray:
    """Pairs (k, 2) of positively oriented tetrahedra on the same side of a face that they share.

    Neighbours list their common face in opposite senses. Where a mesh is tangled they do not,
    though every element has a positive volume. Of three at one face, two are on the same side.
    """
    faces = np.concatenate([elements[:, face] for face in FACES])
    owner = np.tile(np.arange(len(elements)), len(FACES))
    a, b, c = faces.T
    sense = (a < b) ^ (b < c) ^ (a < c)  # of the permutation that sorts the corners
    keys = np.column_stack([np.sort(faces, axis=1), sense])
    order = np.lexsort(keys.T)
    same = (keys[order][1:] == keys[order][:-1]).all(axis=1)
    return np.column_stack([owner[order][:-1][same], owner[order][1:][same]])


def parts(elements: np.ndarray, nodes: int) -> np.ndarray:
    """Number (n,) of the connected part that each of the ``nodes`` belongs to, from 0."""
    first, others = np.repeat(elements[:, 0], elements.shape[1] - 1), elements[:, 1:].ravel()
    graph = coo_array((np.ones(len(first)), (first, others)), shape=(nodes, nodes))
    return connected_components(graph, directed=False)[1]


def coincident(nodes: np.ndarray) -> np.ndarray:
    """Pairs (k, 2) of ``nodes`` at the same place: elements that touch there are not joined."""
    near = _COINCIDENT * np.ptp(nodes, axis=0).max()
    return cKDTree(nodes).query_pairs(near, output_type="ndarray")
