"""Triangulated spherical triangles, and directions between two points of a ball."""

from __future__ import annotations

import numpy as np

from emulator.geometry.body import Midpoints


def triangle_lattice(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """A triangle cut into ``divisions**2``: barycentric coordinates (v, 3), triangles (k, 3)."""
    n = divisions
    corners = [(i, j) for i in range(n + 1) for j in range(n + 1 - i)]
    number = {corner: k for k, corner in enumerate(corners)}
    upright = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in corners if i + j < n]
    between = [
        (number[i + 1, j], number[i + 1, j + 1], number[i, j + 1])
        for i, j in corners
        if i + j < n - 1
    ]
    steps = np.array(corners)
    barycentric = np.column_stack([steps, n - steps.sum(axis=1)]) / n
    return barycentric, np.array(upright + between)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at length one; the zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def ball_midpoints(nodes: np.ndarray) -> Midpoints:
    """Middles of edges between ``nodes`` (n, 3): the mean direction at the mean radius.

    An edge from the centre, which has no direction, takes its other end's.
    """
    directions = unit(nodes)
    radii = np.linalg.norm(nodes, axis=1)

    def midpoints(edges: np.ndarray) -> np.ndarray:
        return unit(directions[edges].sum(axis=1)) * radii[edges].mean(axis=1)[:, None]

    return midpoints
