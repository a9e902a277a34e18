"""A disc triangulated by rings of points around its centre."""

from __future__ import annotations

import numpy as np

from emulator.core.errors import InputError


def ring_counts(rings: int, around: int) -> np.ndarray:
    """Points on each ring, (rings,): six more than on the one before, up to ``around``."""
    if rings < 2 or around < 6:
        raise InputError(f"disc: {rings} rings of {around} points; expected at least 2 and 6")
    return np.minimum(6 * np.arange(1, rings + 1), around)


def disc(rings: int, around: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rings of points with the centre as vertex 0.

    Returns
    -------
    radius : (v,) from 0 at the centre to 1 on the outermost ring.
    angle : (v,) polar angle in [0, 2 pi), zero at the centre.
    triangles : (k, 3) vertices, anticlockwise.
    """
    counts = ring_counts(rings, around)
    first = np.concatenate([[1], 1 + np.cumsum(counts)])
    radius = np.repeat(np.arange(rings + 1) / rings, np.concatenate([[1], counts]))
    angles = [np.arange(count) * (2.0 * np.pi / count) for count in counts]
    fan = [(0, 1 + k, 1 + (k + 1) % counts[0]) for k in range(counts[0])]
    between = [
        _zip(first[k], counts[k], first[k + 1], counts[k + 1]) for k in range(len(counts) - 1)
    ]
    return radius, np.concatenate([[0.0], *angles]), np.concatenate([np.array(fan), *between])


def _zip(first_inner: int, inner: int, first_outer: int, outer: int) -> np.ndarray:
    """Triangles between two rings; whichever ring's next point has the smaller angle advances.

    Between rings of equal size, where all next points tie, the inner goes first on one half of the
    disc and the outer on the other: the triangulation is its own mirror image in the line of angle
    zero.
    """
    triangles, i, j = [], 0, 0
    while i < inner or j < outer:
        lead = (i + 1) * outer - (j + 1) * inner
        inner_next = lead < 0 or (lead == 0 and (inner < outer or 2 * (i + 1) <= inner))
        a, b = first_inner + i % inner, first_outer + j % outer
        if inner_next:
            i += 1
            triangles.append((a, b, first_inner + i % inner))
        else:
            j += 1
            triangles.append((a, b, first_outer + j % outer))
    return np.array(triangles)
