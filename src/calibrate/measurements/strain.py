"""Strains at material points."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import numpy as np

from calibrate.measurements.landmarks import spread_landmarks
from calibrate.measurements.local_basis import COMPONENTS, local_directions
from calibrate.measurements.location import locate_gradients
from calibrate.measurements.points import check_distinct, check_table, count_of
from calibrate.measurements.protocol import Field, Labels
from calibrate.measurements.strain_components import Samples, Strains, columns_of, components_in
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.geometry.discretisation import from_quadrature_points
from emulator.geometry.fibres import unit
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Strain(Strains):
    """Green-Lagrange strains (d, c) along ``components`` at ``points`` (d, 3), without unit.

    In linear elements strains and directions (:mod:`calibrate.measurements.local_basis`) are
    constant, and jump from one element to the next.
    """

    components: tuple[str, ...]
    points: np.ndarray
    samples: Samples

    kind: ClassVar[str] = "strain"
    usage: ClassVar[str] = "strain:COMPONENT,...:N"
    names: ClassVar[tuple[str, ...]] = ("strain",)

    @property
    def nodes(self) -> np.ndarray:
        """Nodes of the points' elements, (k,)."""
        return self.samples.nodes

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, c)."""
        return len(self.points), len(self.components)

    @property
    def sites(self) -> Sites:
        """The points, for each component."""
        return Sites.of(self.points, len(self.components))

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Strains (..., d, c)."""
        return self.samples(displacement)

    def labels(self, name: str) -> Labels:
        """Points and components; the reference positions as a constant."""
        point, component = f"point_{name}", f"component_{name}"
        return Labels(
            dims={name: [point, component], f"position_{name}": [point, "axis"]},
            coords={
                point: np.arange(len(self.points)),
                component: list(self.components),
                "axis": ["x", "y", "z"],
            },
            constants={f"position_{name}": self.points},
        )

    def to_json(self) -> dict[str, Any]:
        """Kind, components and reference positions."""
        return {
            "kind": self.kind,
            "components": list(self.components),
            "points": self.points.tolist(),
        }

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        return cls.of(scene, description["components"], np.asarray(description["points"]))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``strain:fibre:24``: at 24 points, uniform over the volume at random."""
        kind, _, rest = word.partition(":")
        if kind != cls.kind:
            return None
        components, _, count = rest.rpartition(":")
        number = count_of(f"{kind}:{count}", kind) if components else None
        if number is None:
            known = ", ".join(COMPONENTS)
            raise InputError(f"observe '{word}': give {cls.usage}; components: {known}")
        points = spread_landmarks(scene, number, seed)
        return cls.names[0], cls.of(scene, components.split(","), points)

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """Reference positions and a column for each component, such as ``E_circ``."""
        columns = columns_of(components_in(tuple(words))) or ("E_circ",)
        position = Field("position_strain", ("x", "y", "z"), where=True)
        return {cls.names[0]: (position, *(Field(column, (column,)) for column in columns))}

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from positions (d, 3) mm and strains (d,) of each component."""
        components = components_in(tuple(arrays))
        values = np.stack([arrays[column] for column in columns_of(components)], axis=-1)
        check_table(arrays["position_strain"], values, "strain")
        return cls.of(scene, components, arrays["position_strain"]), values

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """Reference positions, and the strains of each component."""
        columns = dict(zip(columns_of(self.components), np.asarray(values).T, strict=True))
        return {"position_strain": self.points, **columns}

    @classmethod
    def of(cls, scene: Scene, components: Any, points: np.ndarray) -> Self:
        """See :func:`strains`."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError(f"strain: points of shape {points.shape}; expected (d, 3), finite, mm")
        check_distinct(points, "strains")
        components = tuple(components)
        directions = local_directions(scene, components)
        elements, inside, gradients = locate_gradients(scene.mesh, points)
        weights = from_quadrature_points(scene.mesh.order, inside)
        here = unit(np.einsum("dq,dqci->dci", weights, directions[elements]))
        return cls(components, points, Samples.of(scene.mesh.elements[elements], gradients, here))


def strains(scene: Scene, components: Any, points: np.ndarray) -> Strain:
    """Observe strains along ``components`` at reference positions ``points`` (d, 3) in mm.

    Parameters
    ----------
    components : one or more of ``fibre``, ``cross_fibre``, ``circumferential``, ``longitudinal``
        and ``radial`` (:mod:`calibrate.measurements.local_basis`).

    Raises
    ------
    InputError
        A component that the scene has no direction for, or a point outside the body or
        given twice.
    """
    return Strain.of(scene, (components,) if isinstance(components, str) else components, points)
