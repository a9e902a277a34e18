r"""Quadratic tetrahedra from linear ones, and the next finer mesh of a body.

Linear tetrahedra become quadratic ones; quadratic ones are cut in eight, each again quadratic. The
body keeps its shape: the new nodes lie on the old elements, curved ones included, so that a
displacement is carried over exactly,

.. math:: u_\text{fine} = P\, u, \qquad P_{ia} = N_a(\xi_i),

with the old shape functions :math:`N_a` at each new node :math:`\xi_i`. Old nodes keep their
numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, identity, vstack

from emulator.core.errors import InputError
from emulator.geometry.discretisation import (
    from_quadrature_points,
    quadrature_points,
    shapes_at,
)
from emulator.geometry.fibres import from_elements, unit
from emulator.geometry.mesh import EDGES, Mesh

Midpoints = Callable[[np.ndarray], np.ndarray]


def to_quadratic(mesh: Mesh, midpoints: Midpoints | None = None) -> Mesh:
    """Return ``mesh`` with ten nodes an element; the corners keep their numbers.

    Parameters
    ----------
    mesh : the mesh of linear tetrahedra.
    midpoints : ``midpoints(edges) -> (e, 3)`` places in mm of the nodes on ``edges`` (e, 2), for
        curved surfaces; halfway along each edge by default.

    Returns
    -------
    Mesh whose node sets hold an edge's node where the edge lies on the surface and joins two of
    the set's nodes, and whose facet sets have six nodes a facet.
    """
    if mesh.order != 1:
        raise InputError("mesh: its tetrahedra are quadratic already")
    ends = np.sort(mesh.elements[:, EDGES], axis=2)  # (m, 6, 2)
    edges, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    first = len(mesh.nodes)
    midpoint_positions = mesh.nodes[edges].mean(axis=1) if midpoints is None else midpoints(edges)
    elements = np.hstack([mesh.elements, first + number.reshape(-1, 6)])

    def middle(pairs: np.ndarray) -> np.ndarray:
        """Return the node on each edge given by its ends (..., 2)."""
        key = edges[:, 0] * first + edges[:, 1]
        edges_sought = np.sort(pairs, axis=-1)
        return first + np.searchsorted(key, edges_sought[..., 0] * first + edges_sought[..., 1])

    def grown(nodes: np.ndarray) -> np.ndarray:
        inside = np.isin(outline, nodes).all(axis=1)
        return np.union1d(nodes, middle(outline[inside]))

    sides = [[0, 1], [1, 2], [2, 0]]
    outline = np.unique(np.sort(mesh.surface[:, sides].reshape(-1, 2), axis=1), axis=0)
    facets = {
        name: np.hstack([rows, middle(rows[:, sides])]) for name, rows in mesh.facet_sets.items()
    }
    return Mesh(
        np.vstack([mesh.nodes, midpoint_positions]),
        elements,
        {name: grown(nodes) for name, nodes in mesh.node_sets.items()},
        facets,
    )


def to_linear(mesh: Mesh) -> Mesh:
    """Return the linear tetrahedra between the corners of quadratic ones, nodes renumbered."""
    if mesh.order != 2:
        raise InputError("mesh: its tetrahedra are linear already")
    corners, elements = np.unique(mesh.elements[:, :4], return_inverse=True)

    def numbered(nodes: np.ndarray) -> np.ndarray:
        return np.searchsorted(corners, nodes)

    return Mesh(
        mesh.nodes[corners],
        elements.reshape(-1, 4),
        {name: numbered(np.intersect1d(at, corners)) for name, at in mesh.node_sets.items()},
        {name: numbered(rows[:, :3]) for name, rows in mesh.facet_sets.items()},
    )


def corner_parents(mesh: Mesh) -> np.ndarray:
    """Return the two nodes (n, 2) of :func:`to_linear` that each node of ``mesh`` lies between.

    Both are the same for a corner.
    """
    corners = np.unique(mesh.elements[:, :4])
    parents = np.zeros((len(mesh.nodes), 2), dtype=int)
    parents[mesh.elements[:, 4:]] = np.searchsorted(corners, mesh.elements[:, EDGES])
    parents[corners] = np.arange(len(corners))[:, None]
    return parents


# Four tetrahedra at the corners, four around a diagonal of the octahedron between them: the
# diagonal's ends, and the other four midpoints as a ring.
_CORNERS = ((0, 4, 6, 7), (1, 4, 5, 8), (2, 5, 6, 9), (3, 7, 8, 9))
_DIAGONALS = (((4, 9), (5, 6, 7, 8)), ((5, 7), (4, 6, 9, 8)), ((6, 8), (4, 5, 9, 7)))
_FOUR = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # of a facet: corners, then 01, 12, 20
# Barycentric coordinates (10, 4) of a quadratic tetrahedron's nodes.
_NODES = np.concatenate([np.eye(4), [0.5 * (np.eye(4)[a] + np.eye(4)[b]) for a, b in EDGES]])


def _orient_child(corners: tuple[int, ...]) -> tuple[int, ...]:
    """Return the local nodes of a child, the last two swapped if its volume would be negative."""
    sides = np.diff(_NODES[list(corners), 1:], axis=0)
    a, b, c, d = corners
    return corners if np.linalg.det(sides) > 0.0 else (a, b, d, c)


def _children(diagonal: tuple[int, int], ring: tuple[int, ...]) -> list[tuple[int, ...]]:
    around = [(*diagonal, ring[k], ring[(k + 1) % 4]) for k in range(4)]
    return [_orient_child(corners) for corners in (*_CORNERS, *around)]


# Local nodes (3, 8, 4) of the eight children, for each diagonal.
_EIGHT = np.array([_children(*each) for each in _DIAGONALS])


@dataclass(frozen=True, eq=False)
class Refinement:
    """A finer mesh of the body of ``coarse``.

    mesh : quadratic; element k came from element ``k // children`` of the coarse mesh.
    prolongation : (fine nodes, coarse nodes), sparse; see the module docstring.
    corners : the barycentric coordinates (m, children, 4, 4) of children's corners in parents.
    """

    coarse: Mesh
    mesh: Mesh
    prolongation: csr_matrix
    corners: np.ndarray

    @property
    def children(self) -> int:
        """Elements that each coarse one has become."""
        return self.corners.shape[1]

    def carry(self, u: np.ndarray) -> np.ndarray:
        """Return a nodal field (n, 3) on the finer mesh, equal to the given one at every point."""
        return self.prolongation @ np.asarray(u)

    def directions(self, directions: np.ndarray) -> np.ndarray:
        """Return unit directions (m, 3) or (m, q, 3) at the finer mesh's quadrature points.

        One direction an element is continued linearly first
        (:func:`~emulator.geometry.fibres.from_elements`).
        """
        at_points = from_elements(self.coarse, directions) if directions.ndim == 2 else directions
        inside = np.einsum("qa,mcab->mcqb", quadrature_points(2), self.corners)
        weights = from_quadrature_points(2, inside.reshape(-1, 4))
        weights = weights.reshape(*inside.shape[:3], -1)
        return unit(np.einsum("mcqp,mpi->mcqi", weights, at_points)).reshape(-1, inside.shape[2], 3)


def refined(mesh: Mesh) -> Refinement:
    """Return the next finer mesh: quadratic elements, or each quadratic element in eight."""
    count = len(mesh.elements)
    if mesh.order == 1:
        quadratic = to_quadratic(mesh)
        parents = corner_parents(quadratic)
        rows = np.repeat(np.arange(len(parents)), 2)
        halves = csr_matrix((np.full(len(rows), 0.5), (rows, parents.ravel())))
        return Refinement(mesh, quadratic, halves, np.broadcast_to(np.eye(4), (count, 1, 4, 4)))
    children = _EIGHT[_shortest_diagonal(mesh)]  # (m, 8, 4)
    elements = np.take_along_axis(mesh.elements[:, None], children, axis=2)
    facets = {name: rows[:, _FOUR].reshape(-1, 3) for name, rows in mesh.facet_sets.items()}
    linear = Mesh(mesh.nodes, elements.reshape(-1, 4), mesh.node_sets, facets)
    new: list[csr_matrix] = []

    def midpoints(edges: np.ndarray) -> np.ndarray:
        new.append(_middle_of(mesh, children, elements, edges))
        return new[0] @ mesh.nodes

    quadratic = to_quadratic(linear, midpoints)
    prolongation = vstack([identity(len(mesh.nodes)), new[0]], format="csr")
    return Refinement(mesh, quadratic, prolongation, _NODES[children])


def _shortest_diagonal(mesh: Mesh) -> np.ndarray:
    """Return the shortest diagonal (m,) of the inner octahedron, which gives the best shapes."""
    ends = mesh.nodes[mesh.elements[:, [diagonal for diagonal, _ in _DIAGONALS]]]
    return np.argmin(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2), axis=1)


def _middle_of(
    mesh: Mesh, children: np.ndarray, elements: np.ndarray, edges: np.ndarray
) -> csr_matrix:
    """Return the old shape functions (e, n) at the middle of the children's ``edges`` (e, 2).

    children : (m, 8, 4) local nodes. elements : (m, 8, 4) their nodes.
    """
    size = len(mesh.nodes)
    pairs = np.sort(elements[:, :, EDGES], axis=-1).reshape(-1, 2)
    keys, first = np.unique(pairs[:, 0] * size + pairs[:, 1], return_index=True)
    places = first[np.searchsorted(keys, edges[:, 0] * size + edges[:, 1])]
    local = children[:, :, EDGES].reshape(-1, 2)[places]
    values, _ = shapes_at(2, _NODES[local].mean(axis=1))
    parents = mesh.elements[places // (children.shape[1] * len(EDGES))]
    rows = np.repeat(np.arange(len(edges)), values.shape[1])
    return csr_matrix((values.ravel(), (rows, parents.ravel())), (len(edges), size))
