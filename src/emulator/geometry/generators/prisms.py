"""Tetrahedra of a triangulation extruded through layers."""

from __future__ import annotations

import numpy as np


def extrude(columns: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Three tetrahedra for each prism between two layers of a triangulation.

    A prism's corners are taken in the order of their 2D numbers, so the two prisms that share a
    side cut it along the same diagonal: from the lower number below to the higher number above.

    Parameters
    ----------
    columns : (v, layers + 1) 3D node at each 2D vertex and layer.
    triangles : (k, 3) 2D vertices.

    Returns
    -------
    (3 k layers, 4) elements, not oriented.
    """
    lower, upper = columns[:, :-1], columns[:, 1:]
    a, b, c = np.sort(triangles, axis=1).T
    cut = (
        (lower[a], lower[b], lower[c], upper[c]),
        (lower[a], lower[b], upper[b], upper[c]),
        (lower[a], upper[a], upper[b], upper[c]),
    )
    return np.stack([np.stack(corners, axis=-1) for corners in cut]).reshape(-1, 4)


def stacked(vertices: int, layers: int) -> np.ndarray:
    """Columns (vertices, layers + 1) of nodes numbered layer by layer."""
    return np.arange(vertices * (layers + 1)).reshape(layers + 1, vertices).T
