r"""Where a point lies: in which element of a body, and over which facet of a surface.

A point belongs to the closest element or facet. In the body its distance is zero; a point that
lies slightly outside, or inside the walls of a curved body but not of its mesh, is moved onto the
element. Barycentric coordinates are positive and add up to 1: :math:`\lambda_i = s_i^2 / |s|^2`.
With :math:`x(\lambda) = \sum_a N_a(\lambda)\, X_a` and the cell's size h, Newton's method
(:mod:`emulator.core.small_newton`) finds

.. math:: \min_s \; \frac{|x(\lambda(s)) - p|^2}{2 h^2} + \frac{(|s|^2 - 1)^2}{2} .

The second term fixes the length of s, and is zero at the minimum. Cells are searched in the order
of their spheres' distances until no sphere is closer than the closest point so far.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.small_newton import minimise_by_newton
from emulator.core.units import PIXELS, in_pixels, other_units
from emulator.geometry.discretisation import shapes_at
from emulator.geometry.mesh import Mesh

# How far outside the body a point may lie, as a fraction of the body's size. Measured surface
# points rarely lie on the mesh to the last digit.
_SLACK = 1e-3
_SEVERAL = 3  # points, from which their span is compared with the body's
_LEAST, _MOST = 0.003, 5.0  # limits of the span, in sizes of the body
_AT_A_TIME = 32  # cells that are searched together, the most promising first
# Step of s at the end. To a point on a face s falls by a third a step only, and its square counts.
_TOLERANCE = 1e-7
_BEYOND = 2.0  # no point of a quadratic cell is further from its middle, in distances of its nodes
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
    elements, inside, distances = closest_points(mesh.nodes[mesh.elements], points)
    outside = ~(distances <= _SLACK * mesh.size)
    if outside.any():
        k = int(np.argmax(outside))
        raise InputError(
            f"landmark {k} at {points[k].tolist()} mm lies outside the body, "
            f"about {distances[k]:.2g} mm away"
        )
    return elements, inside


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
    advice = f"{unit} instead of mm? multiply their coordinates by {factor:g}"
    if in_pixels("mm", body / span, factor):
        advice = PIXELS
    raise InputError(f"{len(points)} points span {span:.3g} mm, the body {body:.3g} mm: {advice}")


def closest_points(
    cells: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the cell (d,) closest to each point (d, 3), its barycentric coordinates, its distance.

    The coordinates, (d, 4) in elements and (d, 3) on facets, are those of the closest point.

    cells : the nodes (c, a, 3) of linear or quadratic elements or facets, mm.
    """
    corners = 4 if cells.shape[1] in (4, 10) else 3
    middles = cells.mean(axis=1)
    radii = _BEYOND * np.linalg.norm(cells - middles[:, None], axis=2).max(axis=1)
    indices, coordinates, closest = [], [], []
    for point in points:
        gaps = np.linalg.norm(middles - point, axis=1)
        least = gaps - radii  # no cell is closer than this
        near = np.flatnonzero(least <= (gaps + radii).min())
        order = near[np.argsort(least[near], kind="stable")]
        best = (0, np.zeros(corners), np.inf)
        for begin in range(0, len(order), _AT_A_TIME):
            rows = np.resize(order[begin : begin + _AT_A_TIME], _AT_A_TIME)
            if least[rows[0]] > best[2]:
                break
            inside, distances = map(np.asarray, _closest(cells[rows], point, corners))
            k = int(np.argmin(distances))
            if distances[k] < best[2]:
                best = (int(rows[k]), inside[k], float(distances[k]))
        indices.append(best[0])
        coordinates.append(best[1])
        closest.append(best[2])
    return np.array(indices, dtype=int), np.array(coordinates), np.array(closest)


@partial(jax.jit, static_argnums=2)
def _closest(X: jax.Array, point: jax.Array, corners: int) -> tuple[jax.Array, jax.Array]:
    """Return barycentric coordinates (c, k) and distances (c,) of the closest points of cells."""

    def closest(X: jax.Array) -> tuple[jax.Array, jax.Array]:
        size = jnp.max(jnp.ptp(X, axis=0))

        def barycentric(s: jax.Array) -> jax.Array:
            return s**2 / jnp.sum(s**2)

        def gap(s: jax.Array) -> jax.Array:
            return (_shapes(barycentric(s), len(X)) @ X - point) / size

        def function(s: jax.Array) -> jax.Array:
            return 0.5 * jnp.sum(gap(s) ** 2) + 0.5 * (jnp.sum(s**2) - 1.0) ** 2

        def quadratic(s: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            return *jax.value_and_grad(function)(s), jax.hessian(function)(s)

        # The search starts in the middle: where a coordinate is 0 its slope is 0, and it stays 0.
        middle = jnp.full(corners, corners**-0.5)
        s = minimise_by_newton(quadratic, middle, tolerance=_TOLERANCE).x
        return barycentric(s), size * jnp.linalg.norm(gap(s))

    return jax.vmap(closest)(X)


def _shapes(barycentric: jax.Array, nodes: int) -> jax.Array:
    """Return the shape functions (a,) at barycentric coordinates (k,) of a simplex."""
    if nodes == len(barycentric):
        return barycentric
    ends = barycentric[_EDGES[nodes]]
    return jnp.concatenate([barycentric * (2.0 * barycentric - 1.0), 4.0 * ends[0] * ends[1]])


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
