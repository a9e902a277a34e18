r"""Green-Lagrange strains: at material points, and averaged over segments of a left ventricle.

With the unit vector :math:`e` of the reference body and the derivative :math:`d` of the
displacement along it,

.. math::
    E_{ee} = e \cdot E\, e = \tfrac12 (|F e|^2 - 1) = e \cdot d + \tfrac12\, d \cdot d,
    \qquad d = \frac{\partial u}{\partial X}\, e = \sum_a (\nabla N_a \cdot e)\, u_a ,

because :math:`F e = e + d` (Holzapfel 2000, Equation 2.69). The sum is over the nodes of the
element, so an observed strain depends on a few nodes; rotations leave no strain. Images report the
mean

.. math:: \bar E_s = \frac{1}{|V_s|} \int_{V_s} E_{ee}\, dV

over the reference volume of each of the 17 segments (:mod:`emulator.geometry.heart_wall`), here by
the mesh's quadrature.

**Directions.** In a ventricle's wall the transmural direction :math:`n`
(:mod:`emulator.geometry.fibres`) and the axis :math:`k` from apex to base, that of the scene's
fibre rule or else the normal of the facet set ``base`` or else z, give

.. math:: r = n, \qquad c = k \times n / |k \times n|, \qquad l = n \times c ,

radial (out of the cavity), circumferential and longitudinal (towards the base): the cardiac
coordinates of tagged images. The fibre :math:`f` is the scene's, and the cross-fibre direction
:math:`n \times f / |n \times f|` lies in the wall's tangent plane, across the fibre.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.displacements import spread_landmarks
from calibrate.measurements.location import gradients_at, locate
from calibrate.measurements.observation import DataField, Layout
from calibrate.measurements.points import XYZ, PointObservation, as_points, gather
from emulator.core.errors import InputError
from emulator.geometry.discretisation import from_quadrature_points
from emulator.geometry.facets import mean_normal
from emulator.geometry.fibres import circumferential, unit, wall_depth
from emulator.geometry.heart_wall import SEGMENTS, aha_segments
from emulator.scenes.scene import ENDOCARDIUM, Scene

_WALL = (ENDOCARDIUM, "epicardium")
_BASE = "base"
_LEAST = -0.5  # strain at a stretch of 0

COMPONENTS = {
    "fibre": "E_fibre",
    "cross_fibre": "E_cross",
    "circumferential": "E_circ",
    "longitudinal": "E_long",
    "radial": "E_rad",
}
"""Directions, with the name in files of the strain along each."""


@dataclass(frozen=True, eq=False)
class Strains(PointObservation):
    """Strains (d, c) of ``components`` (c) at d places, made of those at s samples.

    points : the places in the reference body, mm, (d, 3).
    nodes : the nodes of the samples' elements, each once, (k,).
    members : positions in ``nodes`` of each sample's element, (s, a).
    slopes : derivatives of its shape functions along each direction, 1/mm, (s, c, a).
    directions : unit vectors, (s, c, 3).
    prefix : comes before the components' names in files.
    """

    components: tuple[str, ...]
    points: np.ndarray
    nodes: np.ndarray
    members: np.ndarray
    slopes: np.ndarray
    directions: np.ndarray
    prefix: ClassVar[str] = ""

    quantity = "strain"
    unit = "1"
    usual_sd = 0.02
    hint = f"; components: {', '.join(COMPONENTS)}"
    arguments = ("components",)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return strains (..., s, c) of the samples."""
        # Samples come last, so that the loops over them are vectorised.
        u = jnp.moveaxis(displacement, -1, -2)[..., self.members.T]  # (..., 3, a, s)
        slopes = np.moveaxis(self.slopes, 0, -1)[:, None]  # (c, 1, a, s)
        directions = np.moveaxis(self.directions, 0, -1)  # (c, 3, s)
        along = jnp.sum(slopes * u[..., None, :, :, :], axis=-2)  # (..., c, 3, s)
        return jnp.moveaxis(jnp.sum((directions + 0.5 * along) * along, axis=-2), -1, -2)

    @classmethod
    def values_in(cls, *selection: Any) -> tuple[DataField, ...]:
        """Return a field for each component, such as ``E_circ``."""
        columns = (cls.prefix + COMPONENTS[name] for name in selection[0])
        return tuple(DataField(column, (column,)) for column in columns)

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, Layout]:
        """Return the layout of the components in columns, of one as an example where none is."""
        columns = tuple(c for c, column in COMPONENTS.items() if cls.prefix + column in words)
        return {cls.name: cls.layout_of(columns or ("circumferential",))}

    def fault(self, name: str, values: np.ndarray) -> str | None:
        """Return a sentence on strains that no stretch has."""
        if (values <= _LEAST).any():
            return (
                f"{name} goes down to {np.nanmin(values):.3g}; a Green-Lagrange strain is "
                f"above {_LEAST}, where nothing is left of a length"
            )
        return None


class PointStrain(Strains):
    """Green-Lagrange strains (d, c) along ``components`` at ``points`` (d, 3) mm, without unit.

    In linear elements strains and directions are constant, and jump from one element to the next.
    """

    kind = "strain"
    name = "strain"
    place_field = DataField("position_strain", XYZ, where=True)
    spread = staticmethod(lambda scene, _, count, seed: spread_landmarks(scene, count, seed))

    @classmethod
    def of(cls, scene: Scene, components: str | Sequence[str], points: Any) -> Self:
        """Return the observation of strains along ``components`` at material ``points`` (d, 3) mm.

        Parameters
        ----------
        components : one or more of :data:`COMPONENTS`; as text joined by commas.

        Raises
        ------
        InputError
            A component that the scene has no direction for, or a point outside the body or
            given twice.
        """
        points, names = as_points(points, "strain points"), _names(components)
        directions = local_directions(scene, names)
        elements, inside = locate(scene.mesh, points)
        gradients = gradients_at(scene.mesh, elements, inside)
        weights = from_quadrature_points(scene.mesh.order, inside)
        at_points = unit(np.einsum("dq,dqci->dci", weights, directions[elements]))
        nodes, members = gather(scene.mesh.elements[elements])
        return cls(names, points, nodes, members, _slopes(gradients, at_points), at_points)


@dataclass(frozen=True, eq=False)
class SegmentStrain(Strains):
    """Mean Green-Lagrange strains (d, c) of ``segments`` (d,) along ``components``, without unit.

    ``points`` are the segments' centroids.

    weights : share of each sample, a quadrature point, in each segment's volume, (d, s).
    """

    segments: np.ndarray
    weights: np.ndarray

    kind = "segment_strain"
    name = "segment_strain"
    prefix = "mean_"
    place = numbers = "segments"
    row = "segment"
    place_field = DataField("segment", ("segment",), where=True)
    constants = {}  # a segment's number says where it is

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return mean strains (..., d, c)."""
        strains = super().evaluate(displacement, theta)
        return jnp.einsum("ds,...sc->...dc", self.weights, strains)

    @classmethod
    def of(cls, scene: Scene, components: str | Sequence[str], segments: Any = None) -> Self:
        """Return the observation of mean strains along ``components`` in ``segments`` (d,).

        Parameters
        ----------
        components : the components, see :meth:`PointStrain.of`.
        segments : numbers of segments from 1 on; by default all 17.

        Raises
        ------
        InputError
            A component that the scene has no direction for, an unknown segment or one given twice,
            or a mesh so coarse that a segment has no element.
        """
        numbers = np.asarray(range(1, SEGMENTS + 1) if segments is None else segments, dtype=float)
        for number in numbers:
            if number not in range(1, SEGMENTS + 1):
                raise InputError(f"segment {number:g} is unknown; there are 1 to {SEGMENTS}")
            if (numbers == number).sum() > 1:
                raise InputError(f"segment {number:g} is observed twice")
        segments, names = numbers.astype(int), _names(components)
        labels, mesh, grid = aha_segments(scene.mesh), scene.mesh, scene.discretisation
        rows = np.flatnonzero(np.isin(labels, segments))
        element = np.repeat(rows, grid.weights.shape[1])  # of each quadrature point
        gradients = grid.gradients[rows].reshape(len(element), -1, 3)
        directions = local_directions(scene, names)[rows].reshape(len(element), -1, 3)
        volume = grid.weights[rows].ravel() * (labels[element] == segments[:, None])
        weights = volume / volume.sum(axis=1, keepdims=True)
        X = np.einsum("qa,mai->mqi", grid.values, mesh.nodes[mesh.elements[rows]])
        points = weights @ X.reshape(-1, 3)
        nodes, members = gather(mesh.elements[element])
        slopes = _slopes(gradients, directions)
        return cls(names, points, nodes, members, slopes, directions, segments, weights)


strains = PointStrain.of
segment_strains = SegmentStrain.of


def _names(components: str | Sequence[str]) -> tuple[str, ...]:
    return tuple(components.split(",") if isinstance(components, str) else components)


def _slopes(gradients: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return np.einsum("sai,sci->sca", gradients, directions)


def local_directions(scene: Scene, components: Sequence[str]) -> np.ndarray:
    """Return unit vectors (m, q, c, 3) along ``components`` at the quadrature points.

    :class:`InputError` for an unknown component or one that is given twice, a fibre direction where
    the scene has no fibres, or another direction where it has no wall.
    """
    for name in components:
        if name not in COMPONENTS:
            raise InputError(f"strain along '{name}' is unknown; known: {', '.join(COMPONENTS)}")
        if list(components).count(name) > 1:
            raise InputError(f"strain along '{name}' is observed twice; once is enough")
        if "fibre" in name and scene.fibres is None:
            raise InputError(f"strain along '{name}': scene '{scene.name}' has no fibres")
        if "fibre" in name and scene.angles:
            raise InputError(
                f"strain along '{name}': theta turns the fibres of scene '{scene.name}'; observe "
                "strains along circumferential, longitudinal or radial"
            )
    if not components:
        raise InputError(f"strain: name one component or more of {', '.join(COMPONENTS)}")
    if tuple(components) == ("fibre",):  # fibres are defined without a wall
        return scene.fibres_at_points[:, :, None]
    mesh = scene.mesh
    if not mesh.facet_sets.keys() >= set(_WALL):
        known = ", ".join(sorted(mesh.facet_sets)) or "none"
        raise InputError(
            f"strain in wall directions needs facet sets {' and '.join(_WALL)}; "
            f"scene '{scene.name}' has {known}"
        )
    axis = getattr(scene.fibre_rule, "axis", None)
    if axis is None and _BASE in mesh.facet_sets:
        axis = mean_normal(mesh.nodes[mesh.facet_set(_BASE)])
    k = unit(np.asarray((0.0, 0.0, 1.0) if axis is None else axis, dtype=float))
    normal = wall_depth(mesh, _WALL[:1], _WALL[1:]).normal
    n = normal.reshape((*scene.discretisation.weights.shape, 3))
    c = circumferential(n, k)
    basis = {"circumferential": c, "longitudinal": np.cross(n, c), "radial": n}
    if scene.fibres is not None:
        across = np.cross(n, scene.fibres_at_points)
        length = np.linalg.norm(across, axis=-1, keepdims=True)
        if not length.min() > 1e-6:
            raise InputError("strain: a fibre runs through the wall; it has no cross-fibre")
        basis |= {"fibre": scene.fibres_at_points, "cross_fibre": across / length}
    return np.stack([basis[name] for name in components], axis=2)
