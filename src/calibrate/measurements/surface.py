r"""Measurements of a surface: displacements along its normals, and markers that move with it.

**Normal displacements.** An image shows where a surface is, not which of its points is which.
Observed is the displacement along the reference normal :math:`n` of points :math:`X` of the
reference surface,

.. math:: s = u(X) \cdot n(X) .

Points :math:`p` measured anywhere on the deformed surface become such data by their closest points:
with X the point of the reference surface closest to p, :math:`s = (p - X) \cdot n`
(:func:`surface_distances`). This takes the deformed surface over X to be where X itself went. With
the tangential displacement :math:`u_t`, the angle :math:`\alpha` by which the surface has turned
and its curvature :math:`\kappa` the error is about :math:`|u_t| \tan\alpha + \kappa |u_t|^2 / 2`,
which is small for displacements along the normals or small against the radius of the surface.

**Rigid markers** stand on pins, and move with a surface as if it were rigid. The surface's facets,
weighted by area, have the mean :math:`\bar X` at rest and :math:`\bar x` deformed. With
:math:`e_1, e_2` the two principal directions in which the surface extends most, the mean deformed
directions

.. math:: t_i = \sum_a w_a\, (x_a - \bar x)\, (X_a - \bar X) \cdot e_i / s_i ,
          \qquad T = [t_1\; t_2], \qquad Q = T\,(T^T T)^{-1/2}

are made orthonormal in the way that changes them least (polar decomposition; a 2 x 2 matrix S has
the root :math:`(S + \sqrt{\det S}\, I) / \sqrt{\operatorname{tr} S + 2 \sqrt{\det S}}`), and the
third follows as a cross product. With the rotation R that takes :math:`e_i` there, a marker at p
moves by

.. math:: \bar x + R\,(p - \bar X) - p .
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_array

from calibrate.measurements.location import closest_points, facet_shapes
from calibrate.measurements.observation import DataField, Layout
from calibrate.measurements.points import (
    XYZ,
    DisplacementPoints,
    PointObservation,
    as_points,
    gather,
)
from emulator.core.errors import InputError
from emulator.geometry.discretisation import facet_rule
from emulator.geometry.facets import nodal_areas
from emulator.scenes.scene import Scene

_SLACK = 1e-3  # largest distance of a point from the surface, in sizes of the body
_FARTHEST = 1.0  # largest distance of a marker from the surface, in sizes of the body


def spread_on_surface(scene: Scene, facet_set: str, count: int, seed: int) -> np.ndarray:
    """Return ``count`` points (count, 3) mm, uniform over the facets of a set as if flat."""
    rng = np.random.default_rng(seed)
    facets = scene.mesh.nodes[scene.mesh.facet_set(facet_set)]
    side = facets[:, 1:3] - facets[:, :1]
    area = np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1)
    chosen = rng.choice(len(facets), count, p=area / area.sum())
    values, _ = facet_shapes(rng.dirichlet(np.ones(3), count), facets.shape[1])
    return np.einsum("da,dai->di", values, facets[chosen])


class OfFacetSet(PointObservation):
    """An observation of a facet set, whose name is part of the names of columns."""

    arguments = ("facet_set",)

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layout of each facet set in columns; an example where only the kind is."""
        (field,) = cls.value_fields
        prefixes = [name.format("") for name in (field.variable, *field.columns)]
        sets = {w.removeprefix(p): None for w in words for p in prefixes if w.startswith(p)}
        named = sets or (("FACETSET",) if cls.kind in words else ())
        return {cls.name.format(name): cls.layout_of(name) for name in named}


@dataclass(frozen=True, eq=False)
class SurfacePoints(OfFacetSet):
    """Normal displacements (d,) in mm of points of a facet set, positive out of the tissue.

    facet_set : the surface's name in the mesh.
    nodes : the nodes of the points' facets, (k,).
    points, normals : the points, mm, and unit normals in the reference body, (d, 3).
    members : positions in ``nodes`` of each point's facet, (d, 3 or 6).
    weights : shape functions of the facet at the point, (d, 3 or 6).
    """

    facet_set: str
    nodes: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    members: np.ndarray
    weights: np.ndarray

    kind = "surface"
    quantity = "normal displacement"
    unit = "mm"
    usual_sd = 0.5
    name = "surface:{}"
    place_field = DataField("position_{}", XYZ, where=True)
    value_fields = (DataField("un:{}", ("un:{}",)),)
    components = ()
    spread = staticmethod(spread_on_surface)
    constants = {"position": "points", "normal": "normals"}

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return normal displacements (..., d)."""
        along = self._along
        return jnp.einsum("dai,...dai->...d", along, displacement[..., self.members, :])

    @property
    def matrix(self) -> csr_array:
        """The shape functions at the points, times the normals."""
        columns = 3 * self.members[:, :, None] + np.arange(3)
        rows = np.broadcast_to(np.arange(len(columns))[:, None, None], columns.shape)
        entries = (self._along.ravel(), (rows.ravel(), columns.ravel()))
        return csr_array(entries, shape=(len(columns), 3 * len(self.nodes)))

    @property
    def _along(self) -> np.ndarray:
        return self.weights[:, :, None] * self.normals[:, None]

    @classmethod
    def of(cls, scene: Scene, facet_set: str, points: Any, slack: float = _SLACK) -> Self:
        """Return the observation of normal displacements at ``points`` (d, 3) mm of the surface.

        Parameters
        ----------
        facet_set : the name of the surface.
        slack : the largest distance of a point from the surface, as a share of the body's size.

        Raises
        ------
        InputError
            An unknown facet set, or a point further from it than ``slack``.
        """
        points = as_points(points, "surface points", distinct=False)
        facets = scene.mesh.facet_set(facet_set)
        X = scene.mesh.nodes[facets]
        rows, inside, _ = closest_points(X, points)
        weights, slopes = facet_shapes(inside, facets.shape[1])
        X = X[rows]
        feet = np.einsum("da,dai->di", weights, X)
        for k, distance in enumerate(np.linalg.norm(feet - points, axis=1)):
            if not distance <= slack * scene.mesh.size:
                raise InputError(
                    f"surface point {k} at {points[k].tolist()} mm is {distance:.2g} mm away from "
                    f"'{facet_set}' at rest; give points of the reference surface"
                )
        normals = np.cross(*np.einsum("dat,dai->tdi", slopes, X))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        nodes, members = gather(facets[rows])
        return cls(facet_set, nodes, feet, normals, members, weights)


@dataclass(frozen=True, eq=False)
class RigidMarkers(DisplacementPoints, OfFacetSet):
    """Displacements (d, 3) in mm of markers that move rigidly with a facet set.

    facet_set : the surface's name in the mesh.
    points : the markers with the body at rest, mm, (d, 3); they need not lie in it.
    nodes : the nodes of the surface, (k,).
    weights : shares of the nodes in its area, (k,).
    rest : positions of the nodes less their mean, mm, (k, 3).
    mean : the mean of the nodes, mm, (3,).
    axes : rows: the surface's two principal directions, and the normal of both, (3, 3).
    variance : the surface's variance along the two, mm2, (2,).
    """

    facet_set: str
    points: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    rest: np.ndarray
    mean: np.ndarray
    axes: np.ndarray
    variance: np.ndarray

    kind = "markers"
    hint = ", positions from a file"
    quantity = "marker displacement"
    name = "markers:{}"
    place_field = DataField("position_markers_{}", XYZ, where=True)
    value_fields = (DataField("markers:{}", ("mx:{}", "my:{}", "mz:{}")),)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return displacements (..., d, 3) in mm."""
        shift = jnp.einsum("k,...ki->...i", self.weights, displacement)
        x = self.rest + displacement - shift[..., None, :]
        along = self.weights[:, None] * (self.rest @ self.axes[:2].T) / self.variance
        T = jnp.einsum("...ki,kj->...ij", x, along)
        rotation = _orthonormal(T) @ self.axes
        arms = self.points - self.mean
        return shift[..., None, :] + jnp.einsum("...ij,dj->...di", rotation, arms) - arms

    @classmethod
    def of(cls, scene: Scene, facet_set: str, points: Any = None) -> Self:
        """Return the observation of markers on pins that stand on a surface and turn with it.

        Parameters
        ----------
        facet_set : the surface, such as the free end of a beam.
        points : the markers with the body at rest, in the frame of the mesh, mm, (d, 3).

        Raises
        ------
        InputError
            An unknown facet set, or one without extent; a marker given twice, or far from the body;
            no markers, because they cannot be drawn at random.
        """
        if points is None:
            raise InputError(
                f"observe 'markers:{facet_set}': markers stand where they were put; give their "
                "positions in a file, columns x,y,z,mx:FACETSET,my:FACETSET,mz:FACETSET"
            )
        points = as_points(points, "markers")
        mesh, facets = scene.mesh, scene.mesh.facet_set(facet_set)
        low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        distances = np.linalg.norm(points - np.clip(points, low, high), axis=1)
        k = int(np.argmax(distances))
        if distances[k] > _FARTHEST * mesh.size:
            raise InputError(
                f"marker {k} at {points[k].tolist()} mm stands {distances[k]:.3g} mm away from a "
                f"body of {mesh.size:.3g} mm; give positions in the mesh's frame, in mm"
            )
        areas = nodal_areas(mesh.nodes[facets], facet_rule(mesh.order, 2 * mesh.order))
        nodes, row = np.unique(facets, return_inverse=True)
        weights = np.bincount(row.ravel(), areas.ravel(), minlength=len(nodes))
        weights = weights / weights.sum()
        mean = weights @ mesh.nodes[nodes]
        rest = mesh.nodes[nodes] - mean
        variances, vectors = np.linalg.eigh((weights[:, None] * rest).T @ rest)
        if not variances[1] > 1e-6 * variances[2]:
            raise InputError(f"facet set '{facet_set}' is too thin to turn markers with it")
        first, second = vectors[:, 2], vectors[:, 1]
        axes = np.stack([first, second, np.cross(first, second)])
        return cls(facet_set, points, nodes, weights, rest, mean, axes, variances[[2, 1]])


surface_points = SurfacePoints.of
rigid_markers = RigidMarkers.of


def surface_distances(
    scene: Scene, facet_set: str, measured: np.ndarray
) -> tuple[SurfacePoints, np.ndarray]:
    """Return observation and data (d,) in mm from points (d, 3) mm of the deformed surface.

    Which point of the surface each of them was is not known; see the module's docstring for the
    approximation.
    """
    observe = SurfacePoints.of(scene, facet_set, measured, slack=np.inf)
    offsets = np.atleast_2d(np.asarray(measured, dtype=float)) - observe.points
    return observe, np.sum(offsets * observe.normals, axis=1)


def _orthonormal(T: jax.Array) -> jax.Array:
    """Return right-handed axes (..., 3, 3) in columns; two are closest to ``T`` (..., 3, 2)."""
    first, second = T[..., 0], T[..., 1]
    a, b = jnp.sum(first**2, axis=-1), jnp.sum(second**2, axis=-1)
    c = jnp.sum(first * second, axis=-1)
    root = jnp.sqrt(a * b - c**2)
    size = jnp.sqrt(a + b + 2.0 * root)
    # The inverse of the root of [[a, c], [c, b]]; ``root`` is the determinant of that root.
    inverse = 1.0 / (size * root)
    one = ((b + root) * inverse)[..., None] * first - (c * inverse)[..., None] * second
    two = ((a + root) * inverse)[..., None] * second - (c * inverse)[..., None] * first
    return jnp.stack([one, two, jnp.cross(one, two)], axis=-1)
