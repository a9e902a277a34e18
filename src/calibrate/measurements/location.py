r"""Where a point lies: in which element of a body, and over which facet of a surface.

**In the body.** scikit-fem finds the element of a point inside the body. A point outside, or inside
a curved element but not inside its straight-edged one, is moved onto the nearest element, by
inverting the element's map :math:`x(\xi) = \sum_a N_a(\xi)\, X_a` with Newton's method.

**On a surface.** The closest point of a triangle is the foot of the perpendicular to its plane, or,
where the foot lies outside, the closest point of the three edges. On curved facets
:math:`x(\xi) = \sum_a N_a(\xi)\, X_a` that is the start of Gauss-Newton iterations on
:math:`|x(\xi) - p|^2`.
"""

from __future__ import annotations

import numpy as np
from skfem import MeshTet

from emulator.core.errors import InputError
from emulator.core.units import other_units
from emulator.geometry.discretisation import shapes_at
from emulator.geometry.mesh import Mesh

# How far outside the body a point may lie, as a fraction of the body's size. Measured surface
# points rarely lie on the mesh to the last digit.
_SLACK = 1e-3
_SEVERAL = 3  # points, from which their span is compared with the body's
_LEAST, _MOST = 0.003, 5.0  # limits of the span, in sizes of the body
_ON_THE_FACE = 1e-9  # round-off of a barycentric coordinate
_ELEMENTS = 32  # nearest straight-edged elements that are searched for a point
_FACETS = 16  # nearest facets of a surface that are searched for a point
_NEWTON_STEPS = 12  # largest number of steps; an element with straight edges takes one
_GAUSS_NEWTON_STEPS = 20  # the distance of a point on the surface converges quadratically


def locate(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the element (d,) of each point (d, 3) and its barycentric coordinates there, (d, 4).

    :class:`InputError` for a point further outside than a thousandth of the body's size.
    """
    _check_extent(mesh, points)
    straight = MeshTet(mesh.nodes.T.copy(), mesh.corners.T.copy(), sort_t=False, validate=False)
    finder, nodes = straight.element_finder(), mesh.nodes[mesh.elements]
    elements, coordinates = [], []
    for k, point in enumerate(points):
        try:
            element = finder(*point[:, None])
            inside = _invert(nodes[element], point)[0]
            is_inside = bool(inside.min() >= -_ON_THE_FACE)
        except ValueError:  # outside every straight-edged element
            is_inside = False
        if not is_inside:
            element, inside = _nearest(mesh, k, point)
        elements.append(int(element[0]))
        coordinates.append(inside[0])
    return np.array(elements), np.array(coordinates)


def gradients_at(mesh: Mesh, elements: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return reference gradients (d, 4 or 10, 3) of the shape functions, 1/mm, as located."""
    _, slopes = shapes_at(mesh.order, inside)
    jacobian = np.einsum("dai,daj->dij", mesh.nodes[mesh.elements[elements]], slopes)
    # NumPy inverts the matrices, because JAX's batched LAPACK is slow on small ones.
    return np.einsum("daj,dji->dai", slopes, np.linalg.inv(jacobian))


def _check_extent(mesh: Mesh, points: np.ndarray) -> None:
    """Refuse several points that span next to nothing of the body, or far more than the body."""
    if len(points) < _SEVERAL:
        return
    span, body = (float(np.ptp(x, axis=0).max()) for x in (points, mesh.nodes))
    if span == 0.0 or _LEAST * body <= span <= _MOST * body:
        return
    # The unit in which the points' span would be closest to the body's size.
    lengths = other_units("mm").items()
    unit, factor = min(lengths, key=lambda item: abs(np.log(item[1] * span / body)))
    raise InputError(
        f"{len(points)} points span {span:.3g} mm, the body {body:.3g} mm: {unit} instead of mm? "
        f"multiply their coordinates by {factor:g}"
    )


def _invert(X: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric coordinates (c, 4) of ``point`` in elements with nodes ``X`` (c, a, 3).

    They are not clipped: a coordinate below 0 says that the point lies beyond a face. Their
    gradients (c, 4, 3) in space, 1/mm, are returned, too.
    """
    order = 1 if X.shape[1] == 4 else 2
    xi = np.full((len(X), 3), 0.25)
    for _ in range(1 if order == 1 else _NEWTON_STEPS):
        values, slopes = shapes_at(order, _barycentric(xi))
        # d xi / d x, the inverse of the element map's Jacobian; JAX's batched LAPACK is slower.
        inverse = np.linalg.inv(np.einsum("cai,caj->cij", X, slopes))
        step = np.einsum("cji,ci->cj", inverse, point - np.einsum("ca,cai->ci", values, X))
        # Far outside a curved element its map folds: Newton's method stays close to the element.
        xi = xi + step if order == 1 else np.clip(xi + step, -0.5, 1.5)
        if np.abs(step).max() < 1e-13:
            break
    return _barycentric(xi), np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)


def _barycentric(xi: np.ndarray) -> np.ndarray:
    return np.concatenate([1.0 - xi.sum(axis=1, keepdims=True), xi], axis=1)


def _nearest(mesh: Mesh, k: int, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the element nearest to ``point``, and the barycentric coordinates (1, 4) on it."""
    every = mesh.nodes[mesh.elements]
    distances, _ = _onto(every[:, :4], point)
    candidates = np.argsort(distances, kind="stable")[:_ELEMENTS]
    distances, inside = _onto(every[candidates], point)
    best = int(np.argmin(distances))
    if not distances[best] <= _SLACK * mesh.size:
        raise InputError(
            f"landmark {k} at {point.tolist()} mm lies outside the body, "
            f"about {distances[best]:.2g} mm away"
        )
    return candidates[[best]], inside[[best]]


def _onto(X: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the element's closest points to ``point``: distances (c,), coordinates (c, 4).

    The barycentric coordinates are those of the point moved onto the element: from beyond a face
    along its normal; coordinates that are still below 0 are clipped.
    """
    coordinates, gradients = _invert(X, point)
    rows = np.arange(len(X))
    lowest = np.argmin(coordinates, axis=1)
    normal = gradients[rows, lowest]
    beyond = np.minimum(coordinates[rows, lowest], 0.0) / np.sum(normal**2, axis=1)
    inside = coordinates - beyond[:, None] * np.einsum("cai,ci->ca", gradients, normal)
    inside = np.maximum(inside, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    shapes, _ = shapes_at(1 if X.shape[1] == 4 else 2, inside)
    positions = np.einsum("ca,cai->ci", shapes, X)
    return np.linalg.norm(positions - point, axis=1), inside


def closest_point(facets: np.ndarray, point: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the facet closest to ``point`` (3,), and the closest point's barycentric (3,) there.

    ``facets`` (f, 3 or 6, 3) are the positions of the nodes of linear or quadratic facets, mm.
    """
    coordinates, distances = _onto_triangles(facets[:, :3], point)
    candidates = np.arange(len(facets))
    if facets.shape[1] == 6:
        candidates = np.argsort(distances, kind="stable")[:_FACETS]
        coordinates, distances = _onto_curved(facets[candidates], coordinates[candidates], point)
    best = int(np.argmin(distances))
    return int(candidates[best]), coordinates[best]


def facet_shapes(barycentric: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    r"""Return shape functions (f, a) and derivatives (f, a, 2) at barycentric coordinates (f, 3).

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


def _onto_triangles(corners: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each triangle's closest point, barycentric (f, 3), and its distance (f,)."""
    side = corners[:, 1:] - corners[:, :1]
    gram = np.einsum("fai,fbi->fab", side, side)
    right = np.einsum("fai,fi->fa", side, point - corners[:, 0])
    last = np.linalg.solve(gram, right[..., None])[..., 0]
    candidates = [np.column_stack([1.0 - last.sum(axis=1), last])]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = corners[:, j] - corners[:, i]
        t = np.einsum("fi,fi->f", point - corners[:, i], edge) / np.sum(edge**2, axis=1)
        on_edge = np.zeros((len(corners), 3))
        on_edge[:, j] = np.clip(t, 0.0, 1.0)
        on_edge[:, i] = 1.0 - on_edge[:, j]
        candidates.append(on_edge)
    points = np.stack(candidates)
    distances = np.linalg.norm(np.einsum("efa,fai->efi", points, corners) - point, axis=-1)
    distances[0, points[0].min(axis=1) < 0.0] = np.inf  # beyond an edge
    best, rows = np.argmin(distances, axis=0), np.arange(len(corners))
    return points[best, rows], distances[best, rows]


def _onto_curved(
    facets: np.ndarray, barycentric: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return closest points on quadratic facets (f, 6, 3), from a start on straight ones."""
    for _ in range(_GAUSS_NEWTON_STEPS):
        values, slopes = facet_shapes(barycentric, 6)
        offset = point - np.einsum("fa,fai->fi", values, facets)
        tangents = np.einsum("fad,fai->fdi", slopes, facets)
        gram = np.einsum("fdi,fei->fde", tangents, tangents)
        right = np.einsum("fdi,fi->fd", tangents, offset)
        step = np.linalg.solve(gram, right[..., None])[..., 0]
        clipped = np.maximum(barycentric + np.column_stack([-step.sum(axis=1), step]), 0.0)
        barycentric = clipped / clipped.sum(axis=1, keepdims=True)
    values, _ = facet_shapes(barycentric, 6)
    positions = np.einsum("fa,fai->fi", values, facets)
    return barycentric, np.linalg.norm(positions - point, axis=1)
