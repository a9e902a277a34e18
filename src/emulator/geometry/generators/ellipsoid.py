r"""Truncated thick-walled ellipsoid of revolution: the idealised left ventricle.

.. math:: X(r, \phi, t) = (r_s \sin u \cos\phi,\; r_s \sin u \sin\phi,\; -r_l \cos u), \qquad
          u = r\, u_{base}(t), \quad -r_l(t) \cos u_{base}(t) = z_{base}

with ``r`` from 0 at the apex to 1 at the base, ``t`` from 0 on the endocardium to 1 on the
epicardium, and both semi-axes linear in ``t``. The long axis is z, the base a plane on top. The
coordinates ``r`` and ``phi`` belong to a disc that is triangulated by rings around its centre.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body, extrude, stacked
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import Midpoints


def disc(rings: int, around: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rings of points with the centre as vertex 0: six more on each, up to ``around``.

    radius : the radius (v,) from 0 at the centre to 1 on the outermost ring.
    angle : the polar angle (v,) in [0, 2 pi), zero at the centre.
    triangles : the vertices (k, 3) of triangles, anticlockwise.
    """
    if rings < 2 or around < 6:
        raise InputError(f"disc: {rings} rings of {around} points; expected at least 2 and 6")
    counts = np.minimum(6 * np.arange(1, rings + 1), around)
    first = np.concatenate([[1], 1 + np.cumsum(counts)])
    radius = np.repeat(np.arange(rings + 1) / rings, np.concatenate([[1], counts]))
    angles = [np.arange(count) * (2.0 * np.pi / count) for count in counts]
    fan = [(0, 1 + k, 1 + (k + 1) % counts[0]) for k in range(counts[0])]
    between = [
        _zip(first[k], counts[k], first[k + 1], counts[k + 1]) for k in range(len(counts) - 1)
    ]
    return radius, np.concatenate([[0.0], *angles]), np.concatenate([np.array(fan), *between])


def polar(r: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return points (v, 2) of the disc."""
    return np.column_stack([r * np.cos(phi), r * np.sin(phi)])


def _zip(first_inner: int, inner: int, first_outer: int, outer: int) -> np.ndarray:
    """Return triangles between two rings, always advancing to the point of smaller angle.

    Between rings of equal size, where all next points tie, the inner goes first on one half of the
    disc and the outer on the other: the triangulation is its own mirror image in the line of angle
    zero.
    """
    i, j = np.arange(1, inner + 1), np.arange(1, outer + 1)
    turn = np.concatenate([i * outer, j * inner])
    rank = np.concatenate([np.where((inner == outer) & (2 * i > inner), 2, 0), np.ones(outer)])
    on_inner = np.lexsort((rank, turn)) < inner  # the ring of each next point
    i, j = np.cumsum(on_inner), np.cumsum(~on_inner)
    a, b = first_inner + (i - on_inner) % inner, first_outer + (j - ~on_inner) % outer
    c = np.where(on_inner, first_inner + i % inner, first_outer + j % outer)
    return np.column_stack([a, b, c])


_MOST_UNEVEN = 0.5  # beyond, the thin side of a thick-walled ventricle is too thin to mesh


@dataclass(frozen=True)
class EllipsoidalWall:
    """Dimensions of the wall, all in mm.

    short_endocardium, long_endocardium : the semi-axes of the inner surface.
    short_epicardium, long_epicardium : the semi-axes of the outer surface.
    base : the height of the base plane over the ellipsoids' centre.
    """

    short_endocardium: float
    long_endocardium: float
    short_epicardium: float
    long_epicardium: float
    base: float

    def __post_init__(self) -> None:
        inside = self.short_endocardium < self.short_epicardium and (
            self.long_endocardium < self.long_epicardium
        )
        positive = min(self.short_endocardium, self.long_endocardium) > 0.0
        if not np.isfinite(astuple(self)).all() or not (inside and positive):
            raise InputError(
                f"ellipsoid: semi-axes {astuple(self)[:4]} mm (short and long, inside, outside); "
                "expected the endocardium's above zero and below the epicardium's"
            )
        if abs(self.base) >= self.long_endocardium:
            raise InputError(
                f"ellipsoid: base plane at {self.base} mm; expected between "
                f"-{self.long_endocardium} and {self.long_endocardium}, to cut the endocardium"
            )

    def position(self, r: np.ndarray, phi: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the point X(r, phi, t) in mm, (..., 3)."""
        short = self.short_endocardium + t * (self.short_epicardium - self.short_endocardium)
        long = self.long_endocardium + t * (self.long_epicardium - self.long_endocardium)
        u = r * np.arccos(-self.base / long)
        around = short * np.sin(u)
        return np.stack([around * np.cos(phi), around * np.sin(phi), -long * np.cos(u)], axis=-1)

    @property
    def cavity_volume(self) -> float:
        """Volume under the base plane inside the endocardium, mm3."""
        return _volume_below(self.base, self.short_endocardium, self.long_endocardium)

    @property
    def volume(self) -> float:
        """Volume of the wall, mm3."""
        outside = _volume_below(self.base, self.short_epicardium, self.long_epicardium)
        return outside - self.cavity_volume


def _volume_below(height: float, short: float, long: float) -> float:
    """Return the integral of ``pi short^2 (1 - z^2 / long^2)`` from the apex to ``height``."""
    return np.pi * short**2 * (height + long - (height**3 + long**3) / (3.0 * long**2))


LAND = EllipsoidalWall(7.0, 17.0, 10.0, 20.0, base=5.0)
"""Land et al. (2015), problem 2."""

HUMAN = EllipsoidalWall(23.0, 58.0, 34.0, 65.0, base=20.0)
"""Human-sized, dimensions our choice: cavity 96 mL, wall 131 mL, 11 mm thick at the equator and
7 mm at the apex; the cavity is 46 mm wide and 78 mm long."""


def toward_base(radius: np.ndarray, grading: float) -> np.ndarray:
    """Return radii on [0, 1] moved towards the base, 1, where ``grading`` is above 1."""
    if not 0.0 < grading < np.inf:
        raise InputError(f"ellipsoid: grading {grading} of the rings; expected above 0")
    return 1.0 - (1.0 - np.minimum(radius, 1.0)) ** grading


def truncated_ellipsoid(
    wall: EllipsoidalWall,
    rings: int,
    around: int,
    layers: int,
    order: int = 1,
    thicker: tuple[float, float] = (0.0, 0.0),
    grading: float = 1.0,
) -> Mesh:
    r"""Return the wall, meshed by prisms through a disc of rings, each cut in three tetrahedra.

    Parameters
    ----------
    wall : the dimensions in mm.
    rings : the number of rings from apex to base.
    around : the points on a full ring; rings nearer the apex have fewer.
    layers : the number of layers from endocardium to epicardium.
    order : 1, or 2 for quadratic elements with their mid-edge nodes on the true surfaces.
    thicker : the excess thickness at the base, as a fraction, towards an angle :math:`\phi_0`, in
        degrees; at ``t`` = 1 lies what would lie at
        :math:`t = 1 + \alpha\, r \cos(\phi - \phi_0)`.
    grading : ring k of n lies at :math:`r = 1 - (1 - k/n)^g`. Above 1, rings are closer at the
        base, where a fixed wall bends: 1.5 is worth a third of the nodes.

    Returns
    -------
    Mesh with node sets base, apex_endocardium, apex_epicardium (one node each of the last two),
    and facet sets endocardium, epicardium, base.
    """
    if layers < 1:
        raise InputError(f"ellipsoid: {layers} layers through the wall; expected at least 1")
    more, towards = thicker
    if not 0.0 <= more <= _MOST_UNEVEN or not np.isfinite(towards):
        raise InputError(
            f"ellipsoid: a wall thicker by {more} towards {towards} degrees; expected a fraction "
            f"of 0 to {_MOST_UNEVEN} and an angle"
        )
    radius, angle, triangles = disc(rings, around)
    radius = toward_base(radius, grading)
    r, phi = np.tile(radius, layers + 1), np.tile(angle, layers + 1)
    t = np.repeat(np.arange(layers + 1) / layers, len(radius))
    depth = t * (1.0 + more * r * np.cos(phi - np.radians(towards)))
    base = np.flatnonzero(r == 1.0)
    apex = np.flatnonzero(r == 0.0)
    surfaces = {
        "endocardium": np.flatnonzero(t == 0.0),
        "epicardium": np.flatnonzero(t == 1.0),
        "base": base,
    }
    return body(
        wall.position(r, phi, depth),
        extrude(stacked(len(radius), layers), triangles),
        surfaces,
        {"base": base, "apex_endocardium": apex[:1], "apex_epicardium": apex[-1:]},
        wall_midpoints(wall, r, phi, depth),
        order,
    )


def wall_midpoints(
    wall: EllipsoidalWall, r: np.ndarray, phi: np.ndarray, t: np.ndarray
) -> Midpoints:
    """Return the midpoints of edges between nodes at ``r``, ``phi``, ``t``, each (n,).

    Halfway in the disc with polar coordinates r and phi, where the apex is no special point; for
    edges on the disc's rim, which is the base, halfway along the rim.
    """
    disc_points = polar(r, phi)

    def midpoints(edges: np.ndarray) -> np.ndarray:
        x, y = disc_points[edges].mean(axis=1).T
        on_rim = (r[edges] == 1.0).all(axis=1)
        radius = np.where(on_rim, 1.0, np.hypot(x, y))
        return wall.position(radius, np.arctan2(y, x), t[edges].mean(axis=1))

    return midpoints


def land_ventricle(rings: int = 10, around: int = 24, layers: int = 2, order: int = 1) -> Mesh:
    """Return the ellipsoid ``LAND`` of Land et al. (2015), problem 2."""
    return truncated_ellipsoid(LAND, rings, around, layers, order)


def human_ventricle(
    rings: int = 15, around: int = 30, layers: int = 3, order: int = 1, grading: float = 1.0
) -> Mesh:
    """Return the human-sized left ventricle ``HUMAN`` for daily use."""
    return truncated_ellipsoid(HUMAN, rings, around, layers, order, grading=grading)
