"""Displacements of material points between nodes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.location import locate
from calibrate.measurements.points import (
    DISPLACEMENT,
    DISPLACEMENT_FIELD,
    DisplacementPoints,
    check_distinct,
    check_table,
    count_of,
)
from calibrate.measurements.protocol import Field
from emulator.core.errors import InputError
from emulator.geometry.discretisation import shapes_at
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Landmarks(DisplacementPoints):
    """Displacements of material points, interpolated by the shape functions of their element.

    points : (d, 3) mm, positions in the reference body.
    members : (d, a) positions in ``nodes`` of each point's element; a is 4, or 10 where quadratic.
    weights : (d, a) shape functions of the element at the point.
    """

    nodes: np.ndarray
    points: np.ndarray
    members: np.ndarray
    weights: np.ndarray

    kind: ClassVar[str] = "landmarks"
    usage: ClassVar[str] = "landmarks:N"

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Interpolated displacements (..., d, 3)."""
        values = displacement[..., self.members, :]
        return jnp.sum(values * self.weights[:, :, None], axis=-2)

    def to_json(self) -> dict[str, Any]:
        """Kind and reference positions."""
        return {"kind": self.kind, "points": self.points.tolist()}

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        return cls.of(scene, np.asarray(description["points"]))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``landmarks:N``, uniform over the volume at random."""
        count = count_of(word, cls.kind)
        if count is None:
            return None
        return DISPLACEMENT, cls.of(scene, spread_landmarks(scene, count, seed))

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """Reference positions and displacements."""
        return {DISPLACEMENT: (Field("position", ("x", "y", "z"), where=True), DISPLACEMENT_FIELD)}

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from positions and displacements, both (d, 3) in mm."""
        points, values = arrays["position"], arrays[DISPLACEMENT]
        check_table(points, values)
        try:
            return cls.of(scene, points), values
        except InputError as error:
            if _are_deformed(scene, points, values):
                raise InputError(
                    f"{error}; less their displacements all points lie inside: give positions at "
                    "rest"
                ) from error
            raise

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """Reference positions and displacements."""
        return {"position": self.points, DISPLACEMENT: np.asarray(values)}

    @classmethod
    def of(cls, scene: Scene, points: np.ndarray) -> Self:
        """See :func:`landmarks`."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError(f"landmarks have shape {points.shape}; expected (d, 3), finite, in mm")
        check_distinct(points, "landmarks")
        elements, weights = locate(scene.mesh, points)
        members = scene.mesh.elements[elements]
        nodes, position = np.unique(members, return_inverse=True)
        return cls(nodes, points, position.reshape(members.shape), weights)


def _are_deformed(scene: Scene, points: np.ndarray, values: np.ndarray) -> bool:
    """Whether points (d, 3) less their displacements, and not as they are, lie in the body."""
    seen = np.isfinite(values).all(axis=1)
    try:
        locate(scene.mesh, points[seen] - values[seen])
    except InputError:
        return False
    return bool(seen.any())


def landmarks(scene: Scene, points: np.ndarray) -> Landmarks:
    """Observe material points given by reference positions ``points`` (d, 3) in mm.

    Raises
    ------
    InputError
        A point that lies neither in an element nor just beside one, or is given twice.
    """
    return Landmarks.of(scene, points)


def spread_landmarks(scene: Scene, count: int, seed: int) -> np.ndarray:
    """``count`` points (count, 3) mm, uniform over the volume of the reference body."""
    rng = np.random.default_rng(seed)
    volumes = scene.discretisation.weights.sum(axis=1)
    elements = rng.choice(len(volumes), count, p=volumes / volumes.sum())
    # Uniform in the reference element: uniform in an element with straight edges.
    barycentric = rng.dirichlet(np.ones(4), count)
    weights, _ = shapes_at(scene.mesh.order, barycentric)
    return np.einsum("da,dai->di", weights, scene.mesh.nodes[scene.mesh.elements[elements]])
