r"""Area vectors and volumes of surface facets, linear or quadratic.

A facet with nodes :math:`x_a` has the area vector per reference area
:math:`n = \partial x/\partial\xi \times \partial x/\partial\eta`, in mm2; it points out of the
tissue. The cone from the origin over it has the volume :math:`\frac13 \int x \cdot n\, d\xi d\eta`.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from emulator.geometry.discretisation import FacetRule, facet_rule


def area_vectors(x: jax.Array, rule: FacetRule) -> jax.Array:
    """``n`` at each quadrature point of a facet ``x`` (a, 3) mm, shape (q, 3) in mm2."""
    along = jnp.einsum("qad,ai->qdi", rule.derivatives, x)
    return jnp.cross(along[:, 0], along[:, 1])


def nodal_areas(corners: np.ndarray, rule: FacetRule) -> np.ndarray:
    """Integral of each shape function over the facets ``corners`` (k, a, 3), (k, a) in mm2."""
    area = np.linalg.norm(_normals(corners, rule), axis=-1)
    return np.einsum("q,kq,qa->ka", rule.weights, area, rule.values)


def nodal_area_vectors(corners: np.ndarray, rule: FacetRule) -> np.ndarray:
    """Integral of each shape function times the normal over ``corners`` (k, a, 3), (k, a, 3)."""
    return np.einsum("q,kqi,qa->kai", rule.weights, _normals(corners, rule), rule.values)


def _normals(corners: np.ndarray, rule: FacetRule) -> np.ndarray:
    """:func:`area_vectors` of all facets ``corners`` (k, a, 3) at rest, (k, q, 3) in mm2."""
    along = np.einsum("qad,kai->kqdi", rule.derivatives, corners)
    return np.cross(along[:, :, 0], along[:, :, 1])


def cone_volume(x: jax.Array) -> jax.Array:
    """Signed volume between the origin and one facet ``x`` (3 or 6, 3), mm3; exact for both."""
    if len(x) == 3:
        return jnp.vdot(x[0], jnp.cross(x[1], x[2])) / 6.0
    rule = facet_rule(2, 4)  # x quadratic, n quadratic
    return jnp.sum(rule.weights[:, None] * (rule.values @ x) * area_vectors(x, rule)) / 3.0


def rim(facets: np.ndarray) -> np.ndarray:
    """Edges that belong to one facet only, oriented along it: (e, 2), or (e, 3) with midpoints."""
    sides = [[0, 1], [1, 2], [2, 0]] if facets.shape[1] == 3 else [[0, 1, 3], [1, 2, 4], [2, 0, 5]]
    edges = np.concatenate([facets[:, side] for side in sides])
    _, first, counts = np.unique(
        np.sort(edges[:, :2], axis=1), axis=0, return_index=True, return_counts=True
    )
    return edges[first[counts == 1]]


def openings(facets: np.ndarray) -> list[np.ndarray]:
    """Rim edges of ``facets``, one array (e, 2 or 3) for each opening."""
    edges = rim(facets)
    if not len(edges):
        return []
    names, ends = np.unique(edges[:, :2], return_inverse=True)
    start, end = ends.reshape(-1, 2).T
    graph = coo_array((np.ones(len(edges)), (start, end)), shape=(len(names),) * 2)
    count, label = connected_components(graph, directed=False)
    return [edges[label[start] == k] for k in range(count)]


def enclosed_volume(facets: np.ndarray) -> Callable[[jax.Array], jax.Array]:
    r"""``x -> V`` in mm3: the volume that ``facets`` (k, 3 or 6) and lids on its openings enclose.

    .. math:: V = \frac13 \oint x \cdot n \, da

    by the divergence theorem, with ``n`` the facets' own normals: positive where they point out of
    the enclosed space. The lid of an opening is a fan from the mean of its rim's corners; ``x`` is
    (n, 3) in mm.
    """
    rims = [(edges, np.unique(edges[:, :2])) for edges in openings(facets)]

    def volume(x: jax.Array) -> jax.Array:
        total = jnp.sum(jax.vmap(cone_volume)(x[facets]))
        for edges, ends in rims:
            middle = jnp.mean(x[ends], axis=0)
            fan = jax.vmap(lambda edge, middle=middle: cone_volume(_lid(edge, middle)))(x[edges])
            total = total + jnp.sum(fan)
        return total

    return volume


def _lid(edge: jax.Array, middle: jax.Array) -> jax.Array:
    """Facet between a rim edge (2 or 3, 3) and ``middle`` (3,), against the wall's orientation."""
    start, end = edge[0], edge[1]
    if len(edge) == 2:
        return jnp.stack([end, start, middle])
    spokes = [0.5 * (start + middle), 0.5 * (middle + end)]
    return jnp.stack([end, start, middle, edge[2], *spokes])
