r"""Area vectors and volumes of surface facets, linear or quadratic.

A facet with nodes :math:`x_a` has the area vector per reference area
:math:`n = \partial x/\partial\xi \times \partial x/\partial\eta`, in mm2; it points out of the
tissue. The cone from the origin over it has the volume :math:`\frac13 \int x \cdot n\, d\xi d\eta`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from emulator.geometry.discretisation import FacetRule, facet_rule


def area_vectors(x: jax.Array, rule: FacetRule) -> jax.Array:
    """``n`` at each quadrature point of a facet ``x`` (a, 3) mm, shape (q, 3) in mm2."""
    slopes = jnp.einsum("qad,ai->qdi", rule.slopes, x)
    return jnp.cross(slopes[:, 0], slopes[:, 1])


def nodal_areas(corners: np.ndarray, rule: FacetRule) -> np.ndarray:
    """Integral of each shape function over the facets ``corners`` (k, a, 3), (k, a) in mm2."""
    slopes = np.einsum("qad,kai->kqdi", rule.slopes, corners)
    area = np.linalg.norm(np.cross(slopes[:, :, 0], slopes[:, :, 1]), axis=-1)
    return np.einsum("q,kq,qa->ka", rule.weights, area, rule.values)


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
