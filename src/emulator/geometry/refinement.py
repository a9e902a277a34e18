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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix, identity, vstack

from emulator.core.errors import InputError
from emulator.geometry.discretisation import from_quadrature_points, quadrature_points, shapes_at
from emulator.geometry.fibres import from_elements, unit
from emulator.geometry.mesh import (
    EDGES,
    SIDES,
    Mesh,
    boundary_facets,
    find_rows,
    orient,
    signed_volumes,
)

_LEAST_JACOBIAN = 0.05  # of the straight element's; curved ones below count as folded
_LEAST_SHARE = 0.1  # of an edge's curvature; less is none
Midpoints = Callable[[np.ndarray], np.ndarray]


def to_quadratic(mesh: Mesh, midpoints: Midpoints | None = None) -> Mesh:
    """Return a linear ``mesh`` with ten nodes an element; the corners keep their numbers.

    Node sets hold an edge's node where the edge lies on the surface and joins two of the set's
    nodes; facet sets have six nodes a facet.

    midpoints : ``midpoints(edges) -> (e, 3)`` places in mm of the nodes on ``edges`` (e, 2), for
        curved surfaces; halfway along each edge by default.
    """
    if mesh.order != 1:
        raise InputError("mesh: its tetrahedra are quadratic already")
    pairs = np.sort(mesh.elements[:, EDGES], axis=2).reshape(-1, 2)
    edges, number = np.unique(pairs, axis=0, return_inverse=True)
    places = mesh.nodes[edges].mean(axis=1) if midpoints is None else midpoints(edges)
    elements = np.hstack([mesh.elements, len(mesh.nodes) + number.reshape(-1, 6)])
    surface = boundary_facets(elements)  # in the order of the linear mesh's

    def grown(nodes: np.ndarray) -> np.ndarray:
        within = np.isin(surface[:, SIDES], nodes).all(axis=2)
        return np.union1d(nodes, surface[:, 3:][within])

    return Mesh(
        np.vstack([mesh.nodes, places]),
        elements,
        {name: grown(nodes) for name, nodes in mesh.node_sets.items()},
        {name: surface[find_rows(rows, mesh.surface)] for name, rows in mesh.facet_sets.items()},
    )


def unfolded(mesh: Mesh) -> tuple[Mesh, int]:
    """Return a curved quadratic mesh without folds, and the number of elements that were folded.

    A folded element's Jacobian is next to nothing or negative at a node or quadrature point. The
    nodes on its edges are moved halfway to the middles of the edges, as often as it takes.
    """
    _, slopes = shapes_at(2, np.concatenate([NODES, quadrature_points(2)]))
    edges, middles = mesh.elements[:, EDGES], mesh.elements[:, 4:]
    chord, share = mesh.nodes.copy(), np.ones((len(mesh.nodes), 1))
    chord[middles] = mesh.nodes[edges].mean(axis=2)
    least = _LEAST_JACOBIAN * 6.0 * signed_volumes(mesh.nodes, mesh.elements)
    is_folded = np.zeros(len(mesh.elements), dtype=bool)
    while True:
        nodes = chord + share * (mesh.nodes - chord)
        jacobian = np.einsum("mai,qaj->mqij", nodes[mesh.elements], slopes)
        now = (np.linalg.det(jacobian) < least[:, None]).any(axis=1)
        now &= share[middles].any(axis=(1, 2))  # what is straight already stays as it is
        if not now.any():
            return replace(mesh, nodes=nodes) if is_folded.any() else mesh, int(is_folded.sum())
        is_folded |= now
        bent = np.unique(middles[now])
        share[bent] = np.where(share[bent] > _LEAST_SHARE, 0.5 * share[bent], 0.0)


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
NODES = np.concatenate([np.eye(4), [0.5 * (np.eye(4)[a] + np.eye(4)[b]) for a, b in EDGES]])
"""Barycentric coordinates (10, 4) of a quadratic tetrahedron's nodes."""
# Local nodes (3, 8, 4) of the eight children, for each diagonal.
_AROUND = [[(*ends, ring[k - 1], ring[k]) for k in (1, 2, 3, 0)] for ends, ring in _DIAGONALS]
_EIGHT = orient(NODES[:, 1:], np.concatenate([(*_CORNERS, *around) for around in _AROUND])).reshape(
    3, 8, 4
)


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

    def carry(self, u: ArrayLike) -> np.ndarray:
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
    # The local nodes (m, c, 4) of the children.
    if mesh.order == 1:
        children, linear = np.tile(np.arange(4), (len(mesh.elements), 1, 1)), mesh
    else:
        children = _EIGHT[_shortest_diagonal(mesh)]
        corners = np.take_along_axis(mesh.elements[:, None], children, axis=2)
        facets = {name: rows[:, _FOUR].reshape(-1, 3) for name, rows in mesh.facet_sets.items()}
        linear = Mesh(mesh.nodes, corners.reshape(-1, 4), mesh.node_sets, facets)
    # The old shape functions at the middle of each new edge, in a child that has it.
    pairs = np.sort(linear.elements[:, EDGES], axis=2).reshape(-1, 2)
    _, first = np.unique(pairs, axis=0, return_index=True)
    middles = NODES[children[:, :, EDGES].reshape(-1, 2)[first]].mean(axis=1)
    values, _ = shapes_at(mesh.order, middles)
    parents = mesh.elements[first // (children.shape[1] * len(EDGES))]
    rows = np.repeat(np.arange(len(first)), values.shape[1])
    new = csr_matrix((values.ravel(), (rows, parents.ravel())), (len(first), len(mesh.nodes)))
    prolongation = vstack([identity(len(mesh.nodes)), new], format="csr")
    prolongation.eliminate_zeros()
    quadratic = to_quadratic(linear, lambda _: new @ mesh.nodes)
    return Refinement(mesh, quadratic, prolongation, NODES[children])


def _shortest_diagonal(mesh: Mesh) -> np.ndarray:
    """Return the shortest diagonal (m,) of the inner octahedron, which gives the best shapes."""
    ends = mesh.nodes[mesh.elements[:, [diagonal for diagonal, _ in _DIAGONALS]]]
    return np.argmin(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2), axis=1)
