r"""The point of a surface that is closest to a given one.

Straight facets are triangles: a point is dropped onto the plane, or, where its foot lies outside,
onto the nearest of the three edges. On curved facets :math:`x(\xi) = \sum_a N_a(\xi)\, X_a` that
is the start of Gauss-Newton iterations on :math:`|x(\xi) - p|^2`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_CANDIDATES = 16  # nearest facets, by their straight-edged shape, in which a point is sought
_STEPS = 20  # of Gauss-Newton; the distance of a point on the surface converges quadratically


class Foot(NamedTuple):
    """The closest point of a surface.

    facet : row of the facet.
    weights : (a,) shape functions there; a is 3, or 6 where quadratic.
    position : (3,) mm.
    normal : (3,) of length 1, out of the tissue.
    """

    facet: int
    weights: np.ndarray
    position: np.ndarray
    normal: np.ndarray


def foot_on(facets: np.ndarray, point: np.ndarray) -> Foot:
    """The foot of ``point`` (3,) mm on ``facets`` (f, 3 or 6, 3) mm, the coordinates of nodes."""
    coordinates, distances = _onto_triangles(facets[:, :3], point)
    if facets.shape[1] == 6:
        near = np.argsort(distances, kind="stable")[:_CANDIDATES]
        inside, distances = _onto_curved(facets[near], coordinates[near], point)
        best = int(np.argmin(distances))
        return _foot(facets, int(near[best]), inside[best])
    best = int(np.argmin(distances))
    return _foot(facets, best, coordinates[best])


def facet_shapes(barycentric: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    r"""Shape functions (f, a) and derivatives (f, a, 2) at barycentric coordinates (f, 3).

    Corners :math:`\lambda_i`, or :math:`\lambda_i(2\lambda_i - 1)` with :math:`4 \lambda_i
    \lambda_j` at the middle of edges 01, 12 and 20; derivatives are in the last two coordinates.
    """
    along = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    if nodes == 3:
        return barycentric, np.broadcast_to(along, (len(barycentric), 3, 2))
    i, j = np.array([0, 1, 2]), np.array([1, 2, 0])
    L = barycentric
    values = np.concatenate([L * (2.0 * L - 1.0), 4.0 * L[:, i] * L[:, j]], axis=1)
    corners = (4.0 * L - 1.0)[:, :, None] * along
    middles = 4.0 * (L[:, i, None] * along[j] + L[:, j, None] * along[i])
    return values, np.concatenate([corners, middles], axis=1)


def _foot(facets: np.ndarray, facet: int, barycentric: np.ndarray) -> Foot:
    values, slopes = facet_shapes(barycentric[None], facets.shape[1])
    tangents = slopes[0].T @ facets[facet]
    normal = np.cross(tangents[0], tangents[1])
    position = values[0] @ facets[facet]
    return Foot(facet, values[0], position, normal / np.linalg.norm(normal))


def _onto_triangles(corners: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates (f, 3) of the foot on each triangle, and its distance (f,)."""
    side = corners[:, 1:] - corners[:, :1]
    gram = np.einsum("fai,fbi->fab", side, side)
    right = np.einsum("fai,fi->fa", side, point - corners[:, 0])
    last = np.linalg.solve(gram, right[..., None])[..., 0]
    found = [np.column_stack([1.0 - last.sum(axis=1), last])]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = corners[:, j] - corners[:, i]
        t = np.einsum("fi,fi->f", point - corners[:, i], edge) / np.sum(edge**2, axis=1)
        on_edge = np.zeros((len(corners), 3))
        on_edge[:, j] = np.clip(t, 0.0, 1.0)
        on_edge[:, i] = 1.0 - on_edge[:, j]
        found.append(on_edge)
    feet = np.stack(found)
    distances = np.linalg.norm(np.einsum("efa,fai->efi", feet, corners) - point, axis=-1)
    distances[0, found[0].min(axis=1) < 0.0] = np.inf  # beyond an edge
    best, rows = np.argmin(distances, axis=0), np.arange(len(corners))
    return feet[best, rows], distances[best, rows]


def _onto_curved(
    facets: np.ndarray, barycentric: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`_onto_triangles`, on quadratic facets (f, 6, 3), from a start on straight ones."""
    for _ in range(_STEPS):
        values, slopes = facet_shapes(barycentric, 6)
        away = point - np.einsum("fa,fai->fi", values, facets)
        tangents = np.einsum("fad,fai->fdi", slopes, facets)
        gram = np.einsum("fdi,fei->fde", tangents, tangents)
        right = np.einsum("fdi,fi->fd", tangents, away)
        step = np.linalg.solve(gram, right[..., None])[..., 0]
        moved = barycentric + np.column_stack([-step.sum(axis=1), step])
        moved = np.maximum(moved, 0.0)
        barycentric = moved / moved.sum(axis=1, keepdims=True)
    values, _ = facet_shapes(barycentric, 6)
    reached = np.einsum("fa,fai->fi", values, facets)
    return barycentric, np.linalg.norm(reached - point, axis=1)
