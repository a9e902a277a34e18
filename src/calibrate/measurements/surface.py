r"""How far a surface has moved along its own normals.

Of a surface in an image one sees where it is, not which point of it is which. Observed is the
displacement along the reference normal :math:`n` of points :math:`X` of the reference surface,

.. math:: s = u(X) \cdot n(X) .

Points :math:`p` measured anywhere on the deformed surface become such data by their feet: with X
the point of the reference surface closest to p, :math:`s = (p - X) \cdot n`
(:func:`surface_distances`). This takes the deformed surface over X to be where X itself went. With
the tangential displacement :math:`u_t`, the angle :math:`\alpha` by which the surface has turned
and its curvature :math:`\kappa` the error is about :math:`|u_t| \tan\alpha + \kappa |u_t|^2 / 2`:
fit for displacements that are small against the radius of the surface, or along its normals.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.points import check_table, check_values, count_of
from calibrate.measurements.protocol import LENGTH_UNITS, Field, Labels
from calibrate.measurements.surface_location import facet_shapes, foot_on
from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene

_SLACK = 1e-3  # of the body's size: how far from the surface its points may lie
_COLUMN = "un:"


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Normal displacements (d,) in mm of points of a facet set, positive out of the tissue.

    facet_set : the surface's name in the mesh.
    nodes : (k,) of the points' facets.
    points, normals : (d, 3), in the reference body; points in mm.
    members : (d, 3 or 6) positions in ``nodes`` of each point's facet.
    weights : (d, 3 or 6) shape functions of the facet at the point.
    """

    facet_set: str
    nodes: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    members: np.ndarray
    weights: np.ndarray

    kind: ClassVar[str] = "surface"
    usage: ClassVar[str] = "surface:FACETSET:N"
    quantity: ClassVar[str] = "normal displacement"
    unit: ClassVar[str] = "mm"
    other_units: ClassVar[Mapping[str, float]] = LENGTH_UNITS
    default_noise: ClassVar[GaussianNoise] = GaussianNoise(sd=0.5)

    @property
    def shape(self) -> tuple[int, ...]:
        """(d,)."""
        return (len(self.points),)

    @property
    def names(self) -> tuple[str, ...]:
        """``surface:<facet set>``."""
        return (f"{self.kind}:{self.facet_set}",)

    @property
    def sites(self) -> Sites:
        """The points."""
        return Sites.of(self.points, 1)

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Normal displacements (..., d)."""
        along = self.weights[:, :, None] * self.normals[:, None]
        return jnp.einsum("dai,...dai->...d", along, displacement[..., self.members, :])

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` unless ``values`` is (d,), each finite or missing."""
        check_values(name, values, self.shape, self.unit)

    def labels(self, name: str) -> Labels:
        """Points; their reference positions and normals as constants."""
        point, constants = f"point_{name}", {f"position_{name}": self.points}
        constants[f"normal_{name}"] = self.normals
        return Labels(
            dims={name: [point], **{constant: [point, "axis"] for constant in constants}},
            coords={point: np.arange(len(self.points)), "axis": ["x", "y", "z"]},
            constants=constants,
        )

    def to_json(self) -> dict[str, Any]:
        """Kind, facet set and reference positions."""
        return {"kind": self.kind, "facet_set": self.facet_set, "points": self.points.tolist()}

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        return cls.of(scene, description["facet_set"], np.asarray(description["points"]))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``surface:epicardium:40``: at 40 points, uniform over the surface at random."""
        kind, _, rest = word.partition(":")
        if kind != cls.kind:
            return None
        facet_set, _, count = rest.rpartition(":")
        number = count_of(f"{kind}:{count}", kind) if facet_set else None
        if number is None:
            raise InputError(f"observe '{word}': give {cls.usage}")
        found = cls.of(scene, facet_set, spread_on_surface(scene, facet_set, number, seed))
        return found.names[0], found

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """Reference positions and the column ``un:<facet set>``."""
        sets = [w.removeprefix(_COLUMN) for w in words if w.startswith(_COLUMN)]
        return {
            f"{cls.kind}:{name}": (
                Field(f"position_{name}", ("x", "y", "z"), where=True),
                Field(f"{_COLUMN}{name}", (f"{_COLUMN}{name}",)),
            )
            for name in sets or (("FACETSET",) if cls.kind in words else ())
        }

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from positions (d, 3) and normal displacements (d,), mm."""
        facet_set = name.partition(":")[2]
        points, values = arrays[f"position_{facet_set}"], arrays[f"{_COLUMN}{facet_set}"]
        check_table(points, values[:, None], cls.quantity)
        return cls.of(scene, facet_set, points), values

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """Reference positions and normal displacements."""
        columns = f"position_{self.facet_set}", f"{_COLUMN}{self.facet_set}"
        return dict(zip(columns, (self.points, np.asarray(values)), strict=True))

    @classmethod
    def of(cls, scene: Scene, facet_set: str, points: np.ndarray, slack: float = _SLACK) -> Self:
        """See :func:`surface_points`; ``slack`` as a fraction of the body's size."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError(f"surface points have shape {points.shape}; expected (d, 3), finite")
        facets = scene.mesh.facet_set(facet_set)
        feet = [foot_on(scene.mesh.nodes[facets], point) for point in points]
        for k, (foot, point) in enumerate(zip(feet, points, strict=True)):
            away = float(np.linalg.norm(foot.position - point))
            if not away <= slack * scene.mesh.size:
                raise InputError(
                    f"surface point {k} at {point.tolist()} mm is {away:.2g} mm away from "
                    f"'{facet_set}' at rest; give points of the reference surface"
                )
        nodes, position = np.unique(facets[[foot.facet for foot in feet]], return_inverse=True)
        return cls(
            facet_set,
            nodes,
            np.stack([foot.position for foot in feet]),
            np.stack([foot.normal for foot in feet]),
            position.reshape(len(feet), -1),
            np.stack([foot.weights for foot in feet]),
        )


def surface_points(scene: Scene, facet_set: str, points: np.ndarray) -> SurfacePoints:
    """Observe the normal displacement of ``points`` (d, 3) mm of the reference surface.

    Raises
    ------
    InputError
        An unknown facet set, or a point further from it than a thousandth of the body's size.
    """
    return SurfacePoints.of(scene, facet_set, points)


def surface_distances(
    scene: Scene, facet_set: str, measured: np.ndarray
) -> tuple[SurfacePoints, np.ndarray]:
    """Observation and data (d,) in mm from points (d, 3) mm of the deformed surface.

    Which point of the surface each of them was is not known; see the module's docstring for the
    approximation.
    """
    observe = SurfacePoints.of(scene, facet_set, measured, slack=np.inf)
    away = np.atleast_2d(np.asarray(measured, dtype=float)) - observe.points
    return observe, np.sum(away * observe.normals, axis=1)


def spread_on_surface(scene: Scene, facet_set: str, count: int, seed: int) -> np.ndarray:
    """``count`` points (count, 3) mm, uniform over the facets of a set, edges taken as straight."""
    rng = np.random.default_rng(seed)
    facets = scene.mesh.nodes[scene.mesh.facet_set(facet_set)]
    side = facets[:, 1:3] - facets[:, :1]
    area = np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1)
    chosen = rng.choice(len(facets), count, p=area / area.sum())
    values, _ = facet_shapes(rng.dirichlet(np.ones(3), count), facets.shape[1])
    return np.einsum("da,dai->di", values, facets[chosen])
