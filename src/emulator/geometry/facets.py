r"""Area vectors of surface facets, and the volume of a cavity from its wall's displacement.

A facet with nodes :math:`x_a` has the area vector per reference area
:math:`n = \partial x/\partial\xi \times \partial x/\partial\eta`, in mm2; it points out of the
tissue. The cone from the origin over it has the volume :math:`\frac13 \int x \cdot n\, d\xi d\eta`.

The wall of a cavity is a facet set; a flat lid, a fan of facets from the middle of the rim, closes
each of its openings. By the divergence theorem the closed surface encloses

.. math::
    V = \frac13 \int_\Omega \nabla \cdot x \, dv = \frac13 \oint x \cdot n \, da
      = \sum_\text{facets} \frac16\, x_1 \cdot (x_2 \times x_3),

where the last sum is for linear facets; quadratic ones are integrated exactly. A closed surface has
:math:`\oint n\, da = 0`, so the volume does not depend on the origin. The tissue may lie on either
side of the wall, so the sign is chosen once, such that the volume at rest is positive; the volume
stays differentiable.

Functions of NumPy arrays return NumPy arrays: a mesh at rest is measured without compilation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from itertools import permutations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.units import MM3_PER_ML
from emulator.geometry.discretisation import FacetRule, facet_rule
from emulator.geometry.mesh import SIDES, Mesh, cross_sides, parts, unshared

# Nodes of a quadratic facet (corners, then middles of edges 01, 12, 20) as four flat triangles.
_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])


def area_vectors[A: (jax.Array, np.ndarray)](x: A, rule: FacetRule) -> A:
    """Return the normal ``n`` (..., q, 3) mm2 at the points of facets ``x`` (..., a, 3) mm."""
    xp = x.__array_namespace__()
    along = xp.einsum("qad,...ai->...qdi", rule.derivatives, x)
    return xp.cross(along[..., 0, :], along[..., 1, :])


def nodal_areas[A: (jax.Array, np.ndarray)](corners: A, rule: FacetRule) -> A:
    """Return the integral (..., a) mm2 of each shape function over ``corners`` (..., a, 3) mm."""
    xp = corners.__array_namespace__()
    area = xp.sqrt(xp.sum(area_vectors(corners, rule) ** 2, axis=-1))
    return xp.einsum("q,...q,qa->...a", rule.weights, area, rule.values)


def nodal_area_vectors[A: (jax.Array, np.ndarray)](corners: A, rule: FacetRule) -> A:
    """Return the integrals (..., a, 3) mm2 of shape functions times the normal over ``corners``."""
    xp = corners.__array_namespace__()
    normals = area_vectors(corners, rule)
    return xp.einsum("q,...qi,qa->...ai", rule.weights, normals, rule.values)


def cone_volume[A: (jax.Array, np.ndarray)](x: A) -> A:
    """Return the signed volume (...) mm3 between the origin and facets ``x`` (..., 3 or 6, 3)."""
    xp = x.__array_namespace__()
    if x.shape[-2] == 3:
        return xp.sum(x[..., 0, :] * xp.cross(x[..., 1, :], x[..., 2, :]), axis=-1) / 6.0
    rule = facet_rule(2, 4)  # x quadratic, n quadratic
    height = xp.sum((rule.values @ x) * area_vectors(x, rule), axis=-1)
    return height @ rule.weights / 3.0


def cone_form(x: np.ndarray) -> np.ndarray:
    """Return T (m, m, m) mm3, symmetric, with T y y y the :func:`cone_volume` of facets ``y @ x``.

    x : fields of places (m, k, 3 or 6, 3) mm; the cones of all facets are added.
    """
    if x.shape[-2] == 3:
        at, along, across = np.moveaxis(x, -2, 0) / 6.0 ** (1.0 / 3.0)
    else:
        rule = facet_rule(2, 4)
        at = rule.weights[:, None] / 3.0 * (rule.values @ x)
        along, across = np.moveaxis(np.einsum("qad,...ai->...qdi", rule.derivatives, x), -2, 0)
    rows = at.reshape(len(x), -1).T
    form = np.stack([np.cross(one, across).reshape(len(x), -1) @ rows for one in along])
    return np.mean([form.transpose(order) for order in permutations(range(3))], axis=0)


def mean_normal(corners: np.ndarray) -> np.ndarray:
    """Return the unit normal (3,) of all facets ``corners`` (k, 3 or 6, 3) together."""
    normal = cross_sides(corners).sum(axis=0)
    return normal / np.linalg.norm(normal)


def flat_triangles(facets: np.ndarray) -> np.ndarray:
    """Return facets (k, 3 or 6) as flat triangles (k', 3), four for each quadratic one."""
    return facets if facets.shape[1] == 3 else facets[:, _QUARTERS].reshape(-1, 3)


def surface_mesh(facets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (s,) of ``facets``, and flat triangles (k, 3) as rows of these nodes."""
    nodes, places = np.unique(flat_triangles(facets), return_inverse=True)
    return nodes, places.reshape(-1, 3)


def rim(facets: np.ndarray) -> np.ndarray:
    """Return the edges of one facet only, oriented along it: (e, 2), or (e, 3) with midpoints."""
    width = 2 if facets.shape[1] == 3 else 3
    sides = [(*side, 3 + k)[:width] for k, side in enumerate(SIDES)]
    return unshared(np.concatenate([facets[:, side] for side in sides]), 2)


def openings(facets: np.ndarray) -> list[np.ndarray]:
    """Return the rim edges of ``facets``, one array (e, 2 or 3) for each opening."""
    edges = rim(facets)
    nodes, ends = np.unique(edges[:, :2], return_inverse=True)
    ends = ends.reshape(-1, 2)
    label = parts(ends, len(nodes))
    return [edges[label[ends[:, 0]] == k] for k in np.unique(label)]


def enclosed_volume[A: (jax.Array, np.ndarray)](facets: np.ndarray) -> Callable[[A], A]:
    """Return ``x -> V``, the volume (...) mm3 within ``facets`` (k, 3 or 6) and lids on openings.

    It is positive where the facets' own normals point out of the enclosed space. ``x`` is
    (..., n, 3) in mm.
    """
    surface = _closed(facets)
    return lambda x: cone_volume(surface(x)).sum(-1)


def _closed[A: (jax.Array, np.ndarray)](facets: np.ndarray) -> Callable[[A], A]:
    """Return ``x -> facets`` (..., k', 3 or 6, 3) mm: those of ``facets``, and lids on openings."""
    fans: list[tuple[np.ndarray, Callable[[Any], Any]]] = lids(facets)

    def surface(x: A) -> A:
        parts = [x[..., facets, :], *(fan(x[..., nodes, :]) for nodes, fan in fans)]
        return x.__array_namespace__().concatenate(parts, axis=-3)

    return surface


def lids[A: (jax.Array, np.ndarray)](
    facets: np.ndarray,
) -> list[tuple[np.ndarray, Callable[[A], A]]]:
    """Return the lid of each opening of ``facets`` (k, 3 or 6), facing as they do.

    The lid is a fan from the mean of its rim's corners. For each the nodes (r,) of the rim, and the
    function from their places (..., r, 3) mm to the fan's facets (..., e, 3 or 6, 3) mm.
    """
    return [(np.unique(edges), _fan_over(edges)) for edges in openings(facets)]


def _fan_over[A: (jax.Array, np.ndarray)](edges: np.ndarray) -> Callable[[A], A]:
    nodes, rows = np.unique(edges, return_inverse=True)
    rows = rows.reshape(edges.shape)
    ends = np.searchsorted(nodes, np.unique(edges[:, :2]))
    return lambda x: _lids(x[..., rows, :], x[..., ends, :].mean(-2))


def _lids[A: (jax.Array, np.ndarray)](edges: A, middle: A) -> A:
    """Return facets between rim edges (..., e, 2 or 3, 3) and ``middle`` (..., 3), facing in."""
    xp = edges.__array_namespace__()
    start, end = edges[..., 0, :], edges[..., 1, :]
    middle = xp.broadcast_to(middle[..., None, :], start.shape)
    corners = [end, start, middle]
    if edges.shape[-2] == 3:
        corners += [edges[..., 2, :], 0.5 * (start + middle), 0.5 * (middle + end)]
    return xp.stack(corners, axis=-2)


_FLAT = 1e-9  # volumes below this fraction of the mesh's size cubed are round-off: a plane patch


class Cavity:
    """Volume of a cavity as a function of its wall's displacement.

    Parameters
    ----------
    mesh : the mesh that has the wall among its facet sets.
    facet_set : the wall.

    Attributes
    ----------
    nodes : the nodes (k,) of the wall, in the order in which :meth:`__call__` takes them.

    Raises
    ------
    InputError
        The set is missing or encloses no volume.
    """

    def __init__(self, mesh: Mesh, facet_set: str) -> None:
        self.facet_set = facet_set
        facets = mesh.facet_set(facet_set)
        self.nodes: np.ndarray = np.unique(facets)
        X = mesh.nodes[self.nodes]
        self._X = X - X.mean(axis=0)  # less cancellation: coordinates about the centroid
        self._surface = _closed(np.searchsorted(self.nodes, facets))
        signed = float(cone_volume(self._surface(self._X)).sum())
        if abs(signed) <= _FLAT * mesh.size**3:
            raise InputError(
                f"facet set '{facet_set}' encloses no volume: it is flat, or has no inside"
            )
        self._factor = float(np.sign(signed)) / MM3_PER_ML

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Return the volume (...) in mL at the displacement (..., k, 3) mm of the wall's nodes.

        Differentiable; ``displacement[..., cavity.nodes, :]`` restricts a full field.
        """
        x = self._X + jnp.asarray(displacement)
        return self._factor * cone_volume(self._surface(x)).sum(-1)

    def of_modes(self, offset: np.ndarray, modes: np.ndarray) -> Callable[[jax.Array], jax.Array]:
        r"""Return the volume () in mL as a function of the coefficients c (t,) of the wall's modes.

        offset, modes : the displacement is ``offset + c @ modes``, (k, 3) and (t, k, 3) mm.

        It is the integral over the wall to round-off: a cubic form of y = (1, c),

        .. math:: V = \sum_{ijk} T_{ijk}\, y_i y_j y_k, \qquad
            \frac{\partial V}{\partial y_k} = 3 \sum_{ij} T_{ijk}\, y_i y_j

        with T symmetric, so that each pair ij stands once.
        """
        fields = np.concatenate([(self._X + offset)[None], modes])
        first, second = np.triu_indices(len(fields))
        twice = np.where(first == second, 1.0, 2.0)[:, None]
        form = self._factor * twice * cone_form(self._surface(fields))[first, second]

        def rate(y: jax.Array) -> jax.Array:
            return (y[first] * y[second]) @ form

        @jax.custom_jvp  # reverse mode would multiply by the form a second time
        def volume(y: jax.Array) -> jax.Array:
            return y @ rate(y)

        @volume.defjvp
        def slope(at: tuple[jax.Array], along: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
            (y,), (step,) = at, along
            return y @ (third := rate(y)), 3.0 * (third @ step)

        return lambda c: volume(jnp.concatenate([jnp.ones(1), c]))

    @cached_property
    def rest(self) -> float:
        """Volume of the undeformed cavity, mL."""
        return self._factor * float(cone_volume(self._surface(self._X)).sum())


def encloses(mesh: Mesh, facet_set: str) -> bool:
    """Return whether ``facet_set`` is the wall of a cavity; a plane patch encloses nothing."""
    mesh.facet_set(facet_set)  # a set that is not there is an error
    try:
        Cavity(mesh, facet_set)
    except InputError:
        return False
    return True
