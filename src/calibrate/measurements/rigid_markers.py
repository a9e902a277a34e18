r"""Markers on pins that stand on a surface and move with it as if it were rigid.

The surface's facets, weighted by area, have the mean :math:`\bar X` at rest and :math:`\bar x`
deformed. With :math:`e_1, e_2` the two principal directions in which it extends most, the mean
deformed directions

.. math:: t_i = \sum_a w_a\, (x_a - \bar x)\, (X_a - \bar X) \cdot e_i / s_i ,
          \qquad T = [t_1\; t_2], \qquad Q = T\,(T^T T)^{-1/2}

are made orthonormal in the way that changes them least (polar decomposition; a 2 x 2 matrix S has
the root :math:`(S + \sqrt{\det S}\, I) / \sqrt{\operatorname{tr} S + 2 \sqrt{\det S}}`), and the
third follows as a cross product. With the rotation R that takes :math:`e_i` there, a marker at p
moves by

.. math:: \bar x + R\,(p - \bar X) - p .
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.points import DisplacementPoints, check_distinct, check_table
from calibrate.measurements.protocol import Field
from emulator.core.errors import InputError
from emulator.geometry.discretisation import facet_rule
from emulator.geometry.facets import nodal_areas
from emulator.scenes.scene import Scene

_COLUMNS = ("mx:", "my:", "mz:")
_NAMED = "markers:"
_FARTHEST = 1.0  # of the body's size: how far from it a marker may stand


@dataclass(frozen=True, eq=False)
class RigidMarkers(DisplacementPoints):
    """Displacements (d, 3) in mm of markers that move rigidly with a facet set.

    facet_set : the surface's name in the mesh.
    points : (d, 3) mm, the markers with the body at rest; they need not lie in it.
    nodes : (k,) of the surface.
    weights : (k,) shares of the nodes in its area.
    rest : (k, 3) mm, its nodes less their mean.
    mean : (3,) mm.
    axes : (3, 3), rows: its two principal directions, and the one across.
    spread : (2,) mm2, its variance along these.
    """

    facet_set: str
    points: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    rest: np.ndarray
    mean: np.ndarray
    axes: np.ndarray
    spread: np.ndarray

    kind: ClassVar[str] = "markers"
    usage: ClassVar[str] = "markers:FACETSET (positions from a file)"
    quantity: ClassVar[str] = "marker displacement"

    @property
    def names(self) -> tuple[str, ...]:
        """``markers:<facet set>``."""
        return (f"{self.kind}:{self.facet_set}",)

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Displacements (..., d, 3) in mm."""
        moved = jnp.einsum("k,...ki->...i", self.weights, displacement)
        x = self.rest + displacement - moved[..., None, :]
        along = self.weights[:, None] * (self.rest @ self.axes[:2].T) / self.spread
        T = jnp.einsum("...ki,kj->...ij", x, along)
        turned = _orthonormal(T) @ self.axes
        arms = self.points - self.mean
        return moved[..., None, :] + jnp.einsum("...ij,dj->...di", turned, arms) - arms

    def to_json(self) -> dict[str, Any]:
        """Kind, facet set and positions at rest."""
        return {"kind": self.kind, "facet_set": self.facet_set, "points": self.points.tolist()}

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        return cls.of(scene, description["facet_set"], np.asarray(description["points"]))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """None can be drawn at random: pins stand where they were put."""
        if word.partition(":")[0] != cls.kind:
            return None
        raise InputError(
            f"observe '{word}': markers stand where they were put; give their positions in a file, "
            "columns x,y,z,mx:FACETSET,my:FACETSET,mz:FACETSET"
        )

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """Positions at rest and the columns ``mx:<facet set>`` and so on."""
        sets = dict.fromkeys(
            word.removeprefix(column)
            for word in words
            for column in _COLUMNS
            if word.startswith(column)
        )
        named = (word.removeprefix(_NAMED) for word in words if word.startswith(_NAMED))
        sets |= dict.fromkeys(named)
        if not sets and cls.kind in words:
            sets = {"FACETSET": None}
        return {
            f"{_NAMED}{name}": (
                Field(f"position_markers_{name}", ("x", "y", "z"), where=True),
                Field(f"{_NAMED}{name}", tuple(f"{column}{name}" for column in _COLUMNS)),
            )
            for name in sets
        }

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from positions and displacements, both (d, 3) in mm."""
        facet_set = name.partition(":")[2]
        points = arrays[f"position_markers_{facet_set}"]
        values = arrays[f"{_NAMED}{facet_set}"]
        check_table(points, values)
        return cls.of(scene, facet_set, points), values

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """Positions at rest and displacements."""
        return {
            f"position_markers_{self.facet_set}": self.points,
            f"{_NAMED}{self.facet_set}": np.asarray(values),
        }

    @classmethod
    def of(cls, scene: Scene, facet_set: str, points: np.ndarray) -> Self:
        """See :func:`rigid_markers`."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError(f"markers have shape {points.shape}; expected (d, 3), finite, in mm")
        check_distinct(points, "markers")
        mesh, facets = scene.mesh, scene.mesh.facet_set(facet_set)
        low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        away = np.linalg.norm(points - np.clip(points, low, high), axis=1)
        far = int(np.argmax(away))
        if away[far] > _FARTHEST * mesh.size:
            raise InputError(
                f"marker {far} at {points[far].tolist()} mm stands {away[far]:.3g} mm away from a "
                f"body of {mesh.size:.3g} mm; give positions in the mesh's frame, in mm"
            )
        areas = nodal_areas(mesh.nodes[facets], facet_rule(mesh.order, 2 * mesh.order))
        nodes, row = np.unique(facets, return_inverse=True)
        weights = np.bincount(row.ravel(), areas.ravel(), minlength=len(nodes))
        weights = weights / weights.sum()
        mean = weights @ mesh.nodes[nodes]
        rest = mesh.nodes[nodes] - mean
        spread, vectors = np.linalg.eigh((weights[:, None] * rest).T @ rest)
        if not spread[1] > 1e-6 * spread[2]:
            raise InputError(f"facet set '{facet_set}' is too thin to turn markers with it")
        first, second = vectors[:, 2], vectors[:, 1]
        axes = np.stack([first, second, np.cross(first, second)])
        return cls(facet_set, points, nodes, weights, rest, mean, axes, spread[[2, 1]])


def rigid_markers(scene: Scene, facet_set: str, points: np.ndarray) -> RigidMarkers:
    """Observe markers on pins that stand on a surface and turn with it.

    Parameters
    ----------
    facet_set : the surface, such as the free end of a beam.
    points : (d, 3) mm, the markers with the body at rest, in the frame of the mesh.

    Raises
    ------
    InputError
        An unknown facet set, or one without extent; a marker given twice, or far from the body.
    """
    return RigidMarkers.of(scene, facet_set, points)


def _orthonormal(T: jax.Array) -> jax.Array:
    """Right-handed axes (..., 3, 3), in columns, of which two are next to ``T`` (..., 3, 2)."""
    first, second = T[..., 0], T[..., 1]
    a, b = jnp.sum(first**2, axis=-1), jnp.sum(second**2, axis=-1)
    c = jnp.sum(first * second, axis=-1)
    root = jnp.sqrt(a * b - c**2)
    size = jnp.sqrt(a + b + 2.0 * root)
    # The inverse of the root of [[a, c], [c, b]], whose determinant is ``root``.
    inverse = 1.0 / (size * root)
    one = ((b + root) * inverse)[..., None] * first - (c * inverse)[..., None] * second
    two = ((a + root) * inverse)[..., None] * second - (c * inverse)[..., None] * first
    return jnp.stack([one, two, jnp.cross(one, two)], axis=-1)
