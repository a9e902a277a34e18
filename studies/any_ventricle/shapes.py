"""Ventricles of many shapes and meshes: ellipsoids, and walls as irregular as real ones.

A wall is the truncated ellipsoid, and for half of the bodies four kinds of irregularity in sizes of
published statistical atlases and of measured hearts: cross sections that are no circles, an axis
that bends, a wall of regional thickness, and a base plane that is tilted. Their amplitudes are
normal; all other numbers fill their ranges in a low-discrepancy sequence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import norm, qmc

import emulator as em

RANGES = {
    "cavity": (60.0, 190.0),
    "slenderness": (1.35, 2.1),
    "thickness": (0.26, 0.56),
    "apex": (0.45, 1.0),
    "truncation": (0.1, 0.5),
    "endocardium": (40.0, 85.0),
    "epicardium": (-85.0, -35.0),
}
"""The usual ranges of a body.

cavity : its volume at rest, mL. slenderness : the endocardium's long semi-axis over its short one.
thickness : of the wall at the equator over the short semi-axis. apex : its thickness at the apex
over that at the equator. truncation : the height of the base plane over the ellipsoids' centre over
the long semi-axis. endocardium, epicardium : helix angles in degrees.
"""

# Standard deviations of the amplitudes of cos and sin m phi, m = 0, 1, ...
_SECTION = (0.05, 0.0, 0.05, 0.025, 0.015)  # of the distance from the axis
_THICKNESS = (0.08, 0.14, 0.08, 0.05, 0.03)  # of the wall's thickness
_BEND, _TILT = 0.08, 5.0  # of the long semi-axis; degrees

MESHES = ((7, 20, 2), (8, 24, 2), (9, 22, 2), (7, 22, 3), (8, 28, 2), (8, 24, 3))
"""Rings, points around and layers, one of them for each usual body."""


@dataclass(frozen=True)
class Kind:
    """A kind of bodies.

    ranges : of each number of a body, in the order of ``RANGES``. meshes : one of them each.
    amplitudes : factors of the irregularity, the least and the largest.
    """

    ranges: dict[str, tuple[float, float]]
    meshes: tuple[tuple[int, int, int], ...]
    amplitudes: tuple[float, float] = (1.0, 1.0)


ORDINARY = Kind(RANGES, MESHES)
"""Walls as thick as a healthy heart's in the middle of diastole."""

THIN = Kind(
    RANGES
    | {
        "cavity": (60.0, 230.0),
        "slenderness": (1.4, 2.5),
        "thickness": (0.13, 0.4),
        "apex": (0.3, 1.1),
        "truncation": (0.1, 0.6),
    },
    ((12, 32, 1), (10, 26, 1), (8, 24, 2), (14, 30, 1), (9, 28, 2), (12, 36, 1)),
    (0.5, 1.6),
)
"""Thin, long and more irregular ones, as at the end of diastole, most of one layer of elements as
a mesh generator makes them."""

PARAMETERS = (
    em.Parameter("a", "kPa", 0.16, 0.65, "log"),
    em.Parameter("b", "", 0.8, 5.2, "log"),
    em.Parameter("a_f", "kPa", 2.4, 13.0, "log"),
    em.Parameter("b_f", "", 0.8, 5.6, "log"),
    em.Parameter("pressure", "kPa", 0.0, 11.0 * em.loads.KPA_PER_MMHG),
)
"""The box to train on: a quarter wider than the built-in ventricle's, and down to no pressure."""


@dataclass(frozen=True)
class IrregularWall:
    """An ellipsoidal wall whose points are moved by smooth fields that are even at the apex.

    ellipsoid : the wall before it is moved.
    section, thickness : amplitudes (m, 2, 2) of cos and sin m phi, each with two profiles from apex
        to base, of the distance from the axis and of the thickness.
    bend : by how far the apex lies beside the axis, (2,) mm. tilt : slopes of the base plane, (2,).
    """

    ellipsoid: em.generators.EllipsoidalWall
    section: np.ndarray
    thickness: np.ndarray
    bend: np.ndarray
    tilt: np.ndarray

    def position(self, r: np.ndarray, phi: np.ndarray, t: np.ndarray) -> np.ndarray:
        """The point in mm, (..., 3)."""
        factor = 1.0 + _waves(self.thickness, r, phi)
        x = self.ellipsoid.position(r, phi, t * np.clip(factor, 0.4, 1.9))
        x[..., :2] *= (1.0 + np.clip(_waves(self.section, r, phi), -0.35, 0.35))[..., None]
        x[..., :2] += self.bend * ((1.0 - r) ** 2 * (1.0 + 2.0 * r))[..., None]
        x[..., 2] += (r**2 * (x[..., :2] @ self.tilt)) * (r * r)
        return x


def _waves(amplitudes: np.ndarray, r: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """The field of ``amplitudes`` (m, 2, 2), smooth at the apex, where r is 0."""
    profiles = np.stack([r, np.sin(np.pi * r)])
    total = np.zeros(np.shape(r))
    for m, (even, odd) in enumerate(amplitudes):
        waves = np.stack([np.cos(m * phi), np.sin(m * phi)])
        fade = r ** max(m - 1, 0) if m else np.ones_like(r)
        total = total + fade * np.einsum(
            "pw,p...,w...->...", np.stack([even, odd]), profiles, waves
        )
    return total


USUAL = em.scenes.left_ventricle(7, 20, 1)
"""Its law, constants, loads and supports are every body's."""


@dataclass(frozen=True)
class Body:
    """A ventricle of the family: its wall, mesh and helix angles."""

    wall: em.generators.EllipsoidalWall | IrregularWall
    rings: int
    around: int
    layers: int
    angles: tuple[float, float]

    def scene(self, order: int = 2, box: tuple[em.Parameter, ...] = PARAMETERS) -> em.Scene:
        """The scene of this body with the parameters ``box``."""
        mesh = em.generators.truncated_ellipsoid(
            self.wall, self.rings, self.around, self.layers, order, grading=1.5
        )
        rule = em.scenes.Helix(self.angles)
        return replace(
            USUAL,
            name="ventricle",
            mesh=mesh,
            parameters=box,
            fibres=rule.directions(mesh)[0],
            fibre_rule=rule,
            origin={},
        )


def bodies(count: int, seed: int, irregular: float = 0.5, kind: Kind = ORDINARY) -> list[Body]:
    """``count`` bodies of a kind, of which a share ``irregular`` are not ellipsoids."""
    points = qmc.Sobol(len(RANGES) + 2, rng=seed).random_base2(max(count - 1, 1).bit_length())[
        :count
    ]
    return [_body(point, (seed, k), irregular, kind) for k, point in enumerate(points)]


def _body(point: np.ndarray, seed: tuple[int, int], irregular: float, kind: Kind) -> Body:
    at: dict[str, Any] = {
        name: low + x * (high - low)
        for (name, (low, high)), x in zip(kind.ranges.items(), point[:-2], strict=True)
    }
    slender, base = at["slenderness"], at["truncation"]
    # The cavity's volume is pi short^2 long (base + 2/3 - base^3 / 3), base over the long axis.
    short = (1e3 * at["cavity"] / (np.pi * slender * (base + 2 / 3 - base**3 / 3))) ** (1 / 3)
    long, thick = slender * short, at["thickness"] * short
    sizes = (short, long, short + thick, long + at["apex"] * thick, base * long)
    rng = np.random.default_rng(seed)
    least, largest = kind.amplitudes
    factor = least + (largest - least) * rng.random() if largest > least else least
    wall: em.generators.EllipsoidalWall | IrregularWall = em.generators.EllipsoidalWall(*sizes)
    if point[-2] < irregular:
        wall = IrregularWall(
            wall,
            section=factor * _amplitudes(_SECTION, rng),
            thickness=factor * _amplitudes(_THICKNESS, rng),
            bend=factor * _BEND * long * _normal(rng, 2),
            tilt=factor * np.tan(np.radians(_TILT)) * _normal(rng, 2),
        )
    mesh = kind.meshes[int(point[-1] * len(kind.meshes))]
    return Body(wall, *mesh, (at["endocardium"], at["epicardium"]))


def _normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Standard normal numbers between -2 and 2."""
    return norm.ppf(norm.cdf(-2.0) + rng.random(shape) * (norm.cdf(2.0) - norm.cdf(-2.0)))


def _amplitudes(sd: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    drawn = np.asarray(sd)[:, None, None] * _normal(rng, len(sd), 2, 2)
    drawn[0, :, 1] = 0.0
    return drawn
