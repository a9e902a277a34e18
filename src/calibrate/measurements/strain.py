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
the mesh's quadrature. Directions are those of :mod:`calibrate.measurements.local_basis`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.displacements import spread_landmarks
from calibrate.measurements.local_basis import COMPONENTS, local_directions
from calibrate.measurements.location import locate_gradients
from calibrate.measurements.observation import Block, Field
from calibrate.measurements.points import (
    XYZ,
    PointObservation,
    as_points,
    check_distinct,
    gather,
)
from emulator.core.errors import InputError
from emulator.geometry.discretisation import from_quadrature_points
from emulator.geometry.fibres import unit
from emulator.geometry.heart_wall import SEGMENTS, aha_segments
from emulator.scenes.scene import Scene

_LEAST = -0.5  # strain at a stretch of 0


@dataclass(frozen=True, eq=False)
class Samples:
    """Strain components at material points, as a function of nodal displacements.

    nodes : the nodes of the points' elements, each once, (k,).
    members : positions in ``nodes`` of each point's element, (s, a).
    slopes : derivatives of its shape functions along each direction, 1/mm, (s, c, a).
    directions : unit vectors, (s, c, 3).
    """

    nodes: np.ndarray
    members: np.ndarray
    slopes: np.ndarray
    directions: np.ndarray

    @classmethod
    def of(cls, elements: np.ndarray, gradients: np.ndarray, directions: np.ndarray) -> Self:
        """Return samples in elements with nodes ``elements`` (s, a).

        Parameters
        ----------
        gradients : gradients of the shape functions at the points, 1/mm, (s, a, 3).
        directions : unit vectors along which strain is observed, (s, c, 3).
        """
        nodes, members = gather(elements)
        slopes = np.einsum("sai,sci->sca", gradients, directions)
        return cls(nodes, members, slopes, directions)

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Return strains (..., s, c) from the displacement (..., k, 3) mm of ``nodes``."""
        # Points come last, so that the loops over them are vectorised.
        u = jnp.moveaxis(displacement, -1, -2)[..., self.members.T]  # (..., 3, a, s)
        slopes = np.moveaxis(self.slopes, 0, -1)[:, None]  # (c, 1, a, s)
        directions = np.moveaxis(self.directions, 0, -1)  # (c, 3, s)
        along = jnp.sum(slopes * u[..., None, :, :, :], axis=-2)  # (..., c, 3, s)
        return jnp.moveaxis(jnp.sum((directions + 0.5 * along) * along, axis=-2), -1, -2)


class Strains(PointObservation):
    """Strains (d, c) of ``components`` (c) at d places.

    samples : the points at which strain is evaluated.
    prefix : comes before the components' names in files.
    """

    samples: Samples
    prefix: ClassVar[str] = ""

    quantity = "strain"
    unit = "1"
    other_units = {"%": 0.01}
    usual_sd = 0.02
    hint = f"; components: {', '.join(COMPONENTS)}"
    value_fields = ()  # one for each component

    def __post_init__(self) -> None:
        self._derive(nodes=self.samples.nodes)

    @classmethod
    def fields(cls, *selection: Any) -> tuple[Field, ...]:
        """Return the places, and a column for each component, such as ``E_circ``."""
        columns = (cls.prefix + COMPONENTS[name] for name in selection[0])
        return (cls.place_field, *(Field(column, (column,)) for column in columns))

    @classmethod
    def selections(cls, words: Collection[str]) -> list[tuple[Any, ...]]:
        """Return the components that columns name, or one as an example if there are none."""
        components = tuple(c for c, column in COMPONENTS.items() if cls.prefix + column in words)
        return [(components or ("circumferential",),)]

    def block(self, name: str, values: np.ndarray) -> Block:
        """Return the places, and the components in the order of the basis."""
        place, *columns = super().block(name, values)
        order = [self.prefix + column for column in COMPONENTS.values()]
        return [place, *sorted(columns, key=lambda column: order.index(column[0].variable))]

    def check_values(self, name: str, values: np.ndarray) -> None:
        """Refuse infinite values, and those that no stretch has."""
        super().check_values(name, values)
        if (values <= _LEAST).any():
            raise InputError(
                f"data: {name} goes down to {np.nanmin(values):.3g}; a Green-Lagrange strain is "
                f"above {_LEAST}, where nothing is left of a length"
            )


@dataclass(frozen=True, eq=False)
class Strain(Strains):
    """Green-Lagrange strains (d, c) along ``components`` at ``points`` (d, 3) mm, without unit.

    In linear elements strains and directions are constant, and jump from one element to the next.
    """

    components: tuple[str, ...]
    points: np.ndarray
    samples: Samples

    kind = "strain"
    usage = "strain:COMPONENT,...:N"
    name = "strain"
    arguments = ("components", "points")
    place_field = Field("position_strain", XYZ, where=True)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return strains (..., d, c)."""
        return self.samples(displacement)

    @classmethod
    def spread(cls, scene: Scene, selection: str, count: int, seed: int) -> np.ndarray:
        """Return points that are uniform over the volume."""
        return spread_landmarks(scene, count, seed)

    @classmethod
    def of(cls, scene: Scene, components: str | Sequence[str], points: Any) -> Self:
        """Return the observation of strains along ``components`` at material ``points`` (d, 3) mm.

        Parameters
        ----------
        components : one or more of ``fibre``, ``cross_fibre``, ``circumferential``,
            ``longitudinal`` and ``radial`` (:mod:`calibrate.measurements.local_basis`); as text
            joined by commas.

        Raises
        ------
        InputError
            A component that the scene has no direction for, or a point outside the body or
            given twice.
        """
        points = as_points(points, "strain: points of shape {}; expected (d, 3), finite, mm")
        check_distinct(points, "strains")
        names = _names(components)
        directions = local_directions(scene, names)
        elements, inside, gradients = locate_gradients(scene.mesh, points)
        weights = from_quadrature_points(scene.mesh.order, inside)
        at_points = unit(np.einsum("dq,dqci->dci", weights, directions[elements]))
        return cls(names, points, Samples.of(scene.mesh.elements[elements], gradients, at_points))


@dataclass(frozen=True, eq=False)
class SegmentStrain(Strains):
    """Mean Green-Lagrange strains (d, c) of ``segments`` (d,) along ``components``, without unit.

    weights : share of each quadrature point in each segment's volume, (d, s).
    points : the segments' centroids, mm, (d, 3).
    """

    components: tuple[str, ...]
    segments: np.ndarray
    samples: Samples
    weights: np.ndarray
    points: np.ndarray

    kind = "segment_strain"
    usage = "segment_strain:COMPONENT,..."
    name = "segment_strain"
    prefix = "mean_"
    arguments = ("components", "segments")
    place_field = Field("segment", ("segment",), where=True)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return mean strains (..., d, c)."""
        return jnp.einsum("ds,...sc->...dc", self.weights, self.samples(displacement))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """Read ``segment_strain:circumferential,radial``: strains of all 17 segments."""
        kind, _, components = word.partition(":")
        if kind != cls.kind:
            return None
        if not components:
            raise cls.misuse(word)
        return cls.name, cls.of(scene, components)

    @classmethod
    def of(cls, scene: Scene, components: str | Sequence[str], segments: Any = None) -> Self:
        """Return the observation of mean strains along ``components`` in ``segments`` (d,).

        Parameters
        ----------
        components : the components, see :meth:`Strain.of`.
        segments : numbers of segments from 1 on; by default all 17.

        Raises
        ------
        InputError
            A component that the scene has no direction for, an unknown segment or one given twice,
            or a mesh so coarse that a segment has no element.
        """
        segments = _checked(np.arange(1, SEGMENTS + 1) if segments is None else segments)
        names = _names(components)
        directions = local_directions(scene, names)
        labels = aha_segments(scene.mesh)
        rows = np.flatnonzero(np.isin(labels, segments))
        grid = scene.discretisation
        element = np.repeat(rows, grid.weights.shape[1])  # of each quadrature point
        samples = Samples.of(
            scene.mesh.elements[element],
            grid.gradients[rows].reshape(len(element), -1, 3),
            directions[rows].reshape(len(element), -1, 3),
        )
        volume = grid.weights[rows].ravel() * (labels[element] == segments[:, None])
        weights = volume / volume.sum(axis=1, keepdims=True)
        X = np.einsum("qa,mai->mqi", grid.values, scene.mesh.nodes[scene.mesh.elements[rows]])
        return cls(names, segments, samples, weights, weights @ X.reshape(-1, 3))

    def rows(self) -> tuple[str, np.ndarray]:
        """Return the numbers of the segments."""
        return "segment", self.segments

    def constants(self) -> dict[str, np.ndarray]:
        """Return no constants: a segment's number says where it is."""
        return {}


strains = Strain.of
segment_strains = SegmentStrain.of


def _names(components: str | Sequence[str]) -> tuple[str, ...]:
    return tuple(components.split(",") if isinstance(components, str) else components)


def _checked(segments: Any) -> np.ndarray:
    """Return the numbers of segments; :class:`InputError` unless they are whole and unique."""
    numbers = np.asarray(segments, dtype=float)
    for number in numbers:
        if number not in range(1, SEGMENTS + 1):
            raise InputError(f"segment {number:g} is unknown; there are 1 to {SEGMENTS}")
        if (numbers == number).sum() > 1:
            raise InputError(f"segment {number:g} is observed twice")
    return numbers.astype(int)
