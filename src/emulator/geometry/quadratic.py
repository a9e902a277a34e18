"""Quadratic tetrahedra from linear ones, a node on every edge, and linear ones from quadratic."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh
from emulator.geometry.tetrahedra import EDGES

Midpoints = Callable[[np.ndarray], np.ndarray]


def to_quadratic(mesh: Mesh, midpoints: Midpoints | None = None) -> Mesh:
    """``mesh`` with ten nodes an element; the corners keep their numbers.

    Parameters
    ----------
    mesh : linear tetrahedra.
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
    place = mesh.nodes[edges].mean(axis=1) if midpoints is None else midpoints(edges)
    elements = np.hstack([mesh.elements, first + number.reshape(-1, 6)])

    def middle(pairs: np.ndarray) -> np.ndarray:
        """Node on each edge given by its ends (..., 2)."""
        key = edges[:, 0] * first + edges[:, 1]
        wanted = np.sort(pairs, axis=-1)
        return first + np.searchsorted(key, wanted[..., 0] * first + wanted[..., 1])

    def grown(nodes: np.ndarray) -> np.ndarray:
        inside = np.isin(outline, nodes).all(axis=1)
        return np.union1d(nodes, middle(outline[inside]))

    sides = [[0, 1], [1, 2], [2, 0]]
    outline = np.unique(np.sort(mesh.surface[:, sides].reshape(-1, 2), axis=1), axis=0)
    facets = {
        name: np.hstack([rows, middle(rows[:, sides])]) for name, rows in mesh.facet_sets.items()
    }
    return Mesh(
        np.vstack([mesh.nodes, place]),
        elements,
        {name: grown(nodes) for name, nodes in mesh.node_sets.items()},
        facets,
    )


def to_linear(mesh: Mesh) -> Mesh:
    """The linear tetrahedra between the corners of quadratic ones, its nodes numbered anew."""
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
    """Nodes of :func:`to_linear` of ``mesh`` that each of its nodes lies between, (n, 2).

    Both are the same for a corner.
    """
    corners = np.unique(mesh.elements[:, :4])
    parents = np.zeros((len(mesh.nodes), 2), dtype=int)
    parents[mesh.elements[:, 4:]] = np.searchsorted(corners, mesh.elements[:, EDGES])
    parents[corners] = np.arange(len(corners))[:, None]
    return parents
