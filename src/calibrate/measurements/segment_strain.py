r"""Strains averaged over the segments of a left ventricle, as images report them.

.. math:: \bar E_s = \frac{1}{|V_s|} \int_{V_s} E_{ee}\, dV

over the reference volume of each of the 17 segments (:mod:`emulator.geometry.heart_wall`), by the
mesh's quadrature.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.local_basis import COMPONENTS, local_directions
from calibrate.measurements.points import check_table
from calibrate.measurements.protocol import Field, Labels
from calibrate.measurements.strain_components import Samples, Strains, columns_of, components_in
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.geometry.heart_wall import SEGMENTS, aha_segments
from emulator.scenes.scene import Scene

_MEAN = "mean_"  # of column names; strains at points have none


@dataclass(frozen=True, eq=False)
class SegmentStrain(Strains):
    """Mean Green-Lagrange strains (d, c) of ``segments`` (d,) along ``components``, without unit.

    weights : (d, s) share of each quadrature point in each segment's volume.
    centres : (d, 3) mm, the segments' centroids.
    """

    components: tuple[str, ...]
    segments: np.ndarray
    samples: Samples
    weights: np.ndarray
    centres: np.ndarray

    kind: ClassVar[str] = "segment_strain"
    usage: ClassVar[str] = "segment_strain:COMPONENT,..."
    names: ClassVar[tuple[str, ...]] = ("segment_strain",)

    @property
    def nodes(self) -> np.ndarray:
        """Nodes of the segments, (k,)."""
        return self.samples.nodes

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, c)."""
        return len(self.segments), len(self.components)

    @property
    def sites(self) -> Sites:
        """The segments' centroids, for each component."""
        return Sites.of(self.centres, len(self.components))

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Mean strains (..., d, c)."""
        return jnp.einsum("ds,...sc->...dc", self.weights, self.samples(displacement))

    def labels(self, name: str) -> Labels:
        """Segments and components."""
        dims = [f"segment_{name}", f"component_{name}"]
        coords = dict(zip(dims, (self.segments, list(self.components)), strict=True))
        return Labels(dims={name: dims}, coords=coords)

    def to_json(self) -> dict[str, Any]:
        """Kind, components and segments."""
        return {
            "kind": self.kind,
            "components": list(self.components),
            "segments": self.segments.tolist(),
        }

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        return cls.of(scene, description["components"], np.asarray(description["segments"]))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``segment_strain:circumferential,radial``: of all 17 segments."""
        kind, _, components = word.partition(":")
        if kind != cls.kind:
            return None
        if not components:
            known = ", ".join(COMPONENTS)
            raise InputError(f"observe '{word}': give {cls.usage}; components: {known}")
        return cls.names[0], cls.of(scene, components.split(","), np.arange(1, SEGMENTS + 1))

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """Segment numbers and a column for each component, such as ``mean_E_circ``."""
        columns = columns_of(components_in(tuple(words), _MEAN), _MEAN) or (f"{_MEAN}E_circ",)
        segment = Field("segment", ("segment",), where=True)
        return {cls.names[0]: (segment, *(Field(column, (column,)) for column in columns))}

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from segments (d,) and mean strains (d,) of each component."""
        components = components_in(tuple(arrays), _MEAN)
        values = np.stack([arrays[c] for c in columns_of(components, _MEAN)], axis=-1)
        check_table(arrays["segment"], values, "strain")
        return cls.of(scene, components, arrays["segment"]), values

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """Segment numbers, and the mean strains of each component."""
        columns = columns_of(self.components, _MEAN)
        return {"segment": self.segments, **dict(zip(columns, np.asarray(values).T, strict=True))}

    @classmethod
    def of(cls, scene: Scene, components: Any, segments: np.ndarray) -> Self:
        """See :func:`segment_strains`."""
        segments = _checked(segments)
        directions = local_directions(scene, tuple(components))
        labels = aha_segments(scene.mesh)
        rows = np.flatnonzero(np.isin(labels, segments))
        parts = scene.discretisation
        points = parts.weights.shape[1]
        element = np.repeat(rows, points)  # of each quadrature point
        samples = Samples.of(
            scene.mesh.elements[element],
            parts.gradients[rows].reshape(len(element), -1, 3),
            directions[rows].reshape(len(element), -1, 3),
        )
        volume = parts.weights[rows].ravel() * (labels[element] == segments[:, None])
        weights = volume / volume.sum(axis=1, keepdims=True)
        places = np.einsum("qa,mai->mqi", parts.values, scene.mesh.nodes[scene.mesh.elements[rows]])
        return cls(tuple(components), segments, samples, weights, weights @ places.reshape(-1, 3))


def _checked(segments: np.ndarray) -> np.ndarray:
    numbers = np.asarray(segments, dtype=float)
    for number in numbers:
        if number not in range(1, SEGMENTS + 1):
            raise InputError(f"segment {number:g} is unknown; there are 1 to {SEGMENTS}")
        if (numbers == number).sum() > 1:
            raise InputError(f"segment {number:g} is observed twice")
    return numbers.astype(int)


def segment_strains(scene: Scene, components: Any, segments: Any = None) -> SegmentStrain:
    """Observe strains along ``components``, averaged over ``segments`` (d,), by default all 17.

    Parameters
    ----------
    components : as in :func:`~calibrate.measurements.strain.strains`.

    Raises
    ------
    InputError
        A component that the scene has no direction for, an unknown segment or one given twice, or
        a mesh so coarse that a segment has no element.
    """
    names = (components,) if isinstance(components, str) else components
    chosen = np.arange(1, SEGMENTS + 1) if segments is None else np.asarray(segments)
    return SegmentStrain.of(scene, names, chosen)
