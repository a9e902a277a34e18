r"""Where a point lies: in which element of a body, and over which facet of a surface.

**In the body.** scikit-fem finds the element of a point inside the body. A point outside, or inside
a curved element but not inside its straight-edged one, is moved onto the nearest element.

**On a surface.** The closest point of a triangle is the foot of the perpendicular to its plane, or,
where the foot lies outside, the closest point of the three edges. On curved facets that is the
start of a search.

**Closest point of a curved element or facet.** Its barycentric coordinates are positive and add up
to 1: :math:`\lambda_i = s_i^2 / |s|^2`. With :math:`x(\lambda) = \sum_a N_a(\lambda)\, X_a` and
the element's size h, Newton's method (:mod:`emulator.core.small_newton`) finds

.. math:: \min_s \; \frac{|x(\lambda(s)) - p|^2}{2 h^2} + \frac{(|s|^2 - 1)^2}{2} .

The second term fixes the length of s, and is zero at the minimum.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from skfem import MeshTet

from calibrate.measurements.observation import LENGTH_UNITS
from emulator.core.errors import InputError
from emulator.core.small_newton import minimise_by_newton
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
_OFF_EDGE = 0.02  # least barycentric coordinate at which a search starts
# Corners at the ends of the edges (2, e) that the middle nodes of quadratic facets and elements lie
# on, in the order of the nodes.
_EDGES = {
    6: np.array([[0, 1, 2], [1, 2, 0]]),
    10: np.array([[0, 1, 0, 0, 1, 2], [1, 2, 2, 3, 3, 3]]),
}


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
            (element,) = finder(*point[:, None])
        except ValueError:  # outside every straight-edged element
            is_inside = False
        else:
            inside = _straight_coordinates(nodes[[element], :4], point)
            if mesh.order == 2:
                inside, (distance,) = _closest(nodes[[element]], inside, point)
                is_inside = distance <= _ON_THE_FACE * mesh.size
            else:
                is_inside = inside.min() >= -_ON_THE_FACE
            inside = inside[0]
        if not is_inside:
            element, inside = _nearest(mesh, k, point)
        elements.append(int(element))
        coordinates.append(inside)
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
    unit, factor = min(LENGTH_UNITS.items(), key=lambda item: abs(np.log(item[1] * span / body)))
    raise InputError(
        f"{len(points)} points span {span:.3g} mm, the body {body:.3g} mm: {unit} instead of mm? "
        f"multiply their coordinates by {factor:g}"
    )


def _nearest(mesh: Mesh, k: int, point: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the element nearest to ``point``, and the barycentric coordinates (4,) there."""
    nodes = mesh.nodes[mesh.elements]
    coordinates = _straight_coordinates(nodes[:, :4], point)
    inside = np.maximum(coordinates, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    gaps = np.linalg.norm(np.einsum("ca,cai->ci", inside, nodes[:, :4]) - point, axis=1)
    candidates = np.argsort(gaps, kind="stable")[:_ELEMENTS]
    inside, distances = _closest(nodes[candidates], inside[candidates], point)
    best = int(np.argmin(distances))
    if not distances[best] <= _SLACK * mesh.size:
        raise InputError(
            f"landmark {k} at {point.tolist()} mm lies outside the body, "
            f"about {distances[best]:.2g} mm away"
        )
    return int(candidates[best]), inside[best]


def _straight_coordinates(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return barycentric coordinates (c, 4), some below 0 outside, in tetrahedra (c, 4, 3)."""
    sides = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    # NumPy solves the systems, because JAX's batched LAPACK is slow on small ones.
    last = np.linalg.solve(sides, (point - corners[:, 0])[..., None])[..., 0]
    return np.concatenate([1.0 - last.sum(axis=1, keepdims=True), last], axis=1)


def _closest(X: np.ndarray, start: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the closest points to ``point`` (3,): coordinates (c, k) and distances (c,).

    X : the nodes (c, a, 3) of elements (k = 4) or facets (k = 3), linear or quadratic.
    start : barycentric coordinates (c, k) at which the search starts.
    """
    inside, distances = _closest_program(X, start, point)
    return np.asarray(inside), np.asarray(distances)


@jax.jit
def _closest_program(
    X: jax.Array, start: jax.Array, point: jax.Array
) -> tuple[jax.Array, jax.Array]:
    def closest(X: jax.Array, start: jax.Array) -> tuple[jax.Array, jax.Array]:
        size = jnp.max(jnp.ptp(X, axis=0))

        def barycentric(s: jax.Array) -> jax.Array:
            return s**2 / jnp.sum(s**2)

        def gap(s: jax.Array) -> jax.Array:
            return (_shapes(barycentric(s), len(X)) @ X - point) / size

        def function(s: jax.Array) -> jax.Array:
            return 0.5 * jnp.sum(gap(s) ** 2) + 0.5 * (jnp.sum(s**2) - 1.0) ** 2

        def quadratic(s: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            return *jax.value_and_grad(function)(s), jax.hessian(function)(s)

        # The slope along a coordinate that is 0 is 0, too: the search could not leave an edge.
        begin = jnp.sqrt(jnp.maximum(start, _OFF_EDGE))
        s = minimise_by_newton(quadratic, begin / jnp.linalg.norm(begin)).x
        return barycentric(s), size * jnp.linalg.norm(gap(s))

    return jax.vmap(closest)(X, start)


def _shapes(barycentric: jax.Array, nodes: int) -> jax.Array:
    """Return the shape functions (a,) at barycentric coordinates (k,) of a simplex."""
    if nodes == len(barycentric):
        return barycentric
    ends = barycentric[_EDGES[nodes]]
    return jnp.concatenate([barycentric * (2.0 * barycentric - 1.0), 4.0 * ends[0] * ends[1]])


def closest_point(facets: np.ndarray, point: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the facet closest to ``point`` (3,), and the closest point's barycentric (3,) there.

    ``facets`` (f, 3 or 6, 3) are the positions of the nodes of linear or quadratic facets, mm.
    """
    coordinates, distances = _onto_triangles(facets[:, :3], point)
    candidates = np.arange(len(facets))
    if facets.shape[1] == 6:
        candidates = np.argsort(distances, kind="stable")[:_FACETS]
        coordinates, distances = _closest(facets[candidates], coordinates[candidates], point)
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
