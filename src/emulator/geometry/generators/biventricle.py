r"""Idealised heart of two ventricles: a truncated ellipsoid with a pouch on its side.

The free wall of the right ventricle stands on the left one's epicardium. There the epicardium's
mesh is opened along the septum's edge, and the sides of the free wall fill the gap: the two walls
share nodes and facets.

The septum is the half of an oval on the epicardium, cut by the base. Each point of it has a place
in the lower half of a unit disc, :math:`\rho` from the disc's centre. The sheet at depth :math:`s`,
0 on the inside and 1 on the outside, stands along the septum's edge, widened by :math:`s` times the
thickness :math:`h`, and bulges horizontally from the epicardium by

.. math:: (D + s\,h) \cos(\tfrac{\pi}{2} \rho)

at the foot :math:`\sin(\tfrac{\pi}{2} \rho)` from the centre: arcs of ellipses, in even steps.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from skfem import Basis, ElementTriP1, MeshTri, condense, solve
from skfem.models.poisson import laplace

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body, extrude, stacked
from emulator.geometry.generators.ellipsoid import (
    HUMAN,
    EllipsoidalWall,
    disc,
    polar,
    toward_base,
    wall_midpoints,
)
from emulator.geometry.mesh import SIDES, Mesh, find_rows


@dataclass(frozen=True, eq=False)
class Footprint:
    """A sheet opened along a line; the gap is filled by a band of one strip for each level.

    origin : for each vertex, old ones first, the old vertex it is or was copied from.
    line : (p,) old vertices along which the sheet was opened.
    levels : (p, strips + 1) copies of ``line`` on each line of the band; column 0 is ``line``.
    inner : (k, 3) triangles on the near side of the line.
    outer : (k, 3) triangles on the far side, attached to the band's last line.
    band : (k, 3) triangles of the band, cut along the same diagonals as the sides of ``inner``
        extruded through ``strips`` layers (:func:`emulator.geometry.generators.body.extrude`).
    """

    origin: np.ndarray
    line: np.ndarray
    levels: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    band: np.ndarray


def open_sheet(triangles: np.ndarray, inside: np.ndarray, strips: int) -> Footprint:
    """Open a sheet around the triangles whose vertices are all ``inside`` (v,).

    The new vertices are numbered after the old ones, line by line.
    """
    within = inside[triangles].all(axis=1)
    inner, outer = triangles[within], triangles[~within]
    # Edges of both, lower vertex first, as extrude sorts them.
    edges = np.unique(np.sort(inner[:, SIDES].reshape(-1, 2), axis=1), axis=0)
    ends = edges[find_rows(edges, outer[:, SIDES].reshape(-1, 2)) >= 0]
    line = np.unique(ends)
    levels = len(inside) + np.arange(len(line) * strips).reshape(strips, len(line)).T
    levels = np.column_stack([line, levels])
    renumbered = np.arange(len(inside))
    renumbered[line] = levels[:, -1]
    a, b = levels[np.searchsorted(line, ends)].swapaxes(0, 1)
    a0, a1, b0, b1 = (part.ravel() for part in (a[:, :-1], a[:, 1:], b[:, :-1], b[:, 1:]))
    band = np.concatenate([np.column_stack([a0, b0, b1]), np.column_stack([a0, a1, b1])])
    origin = np.concatenate([np.arange(len(inside)), np.tile(line, strips)])
    return Footprint(origin, line, levels, inner, renumbered[outer], band)


def spread(
    points: np.ndarray, triangles: np.ndarray, prescribed: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Return ``points`` (v, 2) with ``prescribed`` (h,) moved to ``places`` (h, 2).

    Displacements are harmonic over ``triangles``: they decay away from ``prescribed`` and keep an
    even grid even. Points outside the triangles stay.
    """
    vertices, local = np.unique(triangles, return_inverse=True)
    basis = Basis(MeshTri(points[vertices].T.copy(), local.reshape(-1, 3).T.copy()), ElementTriP1())
    stiffness = laplace.assemble(basis)
    rows = np.searchsorted(vertices, prescribed)
    result = points.copy()
    for axis in range(2):
        shift = basis.zeros()
        shift[rows] = (places - points[prescribed])[:, axis]
        result[vertices, axis] += solve(*condense(stiffness, x=shift, D=rows))
    return result


@dataclass(frozen=True)
class RightVentricle:
    """Dimensions of the right ventricle; the defaults are our choice.

    half_angle : degrees from the middle of the septum to the cavity's edge at the base.
    apex : the height of the cavity's apex, as a fraction of that from the left apex to the base.
    bulge : the bulge of the cavity at the base, mm.
    thickness : the thickness of the free wall, mm.
    """

    half_angle: float = 72.0
    apex: float = 0.4
    bulge: float = 24.0
    thickness: float = 5.0

    def __post_init__(self) -> None:
        valid = 0.0 < self.half_angle < 150.0 and 0.0 < self.apex < 1.0
        if not (valid and 0.0 < self.bulge < np.inf and 0.0 < self.thickness < np.inf):
            raise InputError(
                f"biventricle: right ventricle {astuple(self)}; expected a half angle below 150 "
                "degrees, an apex below 1, and positive bulge and thickness in mm"
            )


@dataclass(frozen=True, eq=False)
class Septum:
    """The septum on the left wall's epicardium, and the sheet over it.

    Coordinates are ``xi`` from -1 to 1 across, ``eta`` from 0 up to 1 on the base, and depth ``s``.
    """

    left: EllipsoidalWall
    right: RightVentricle

    @property
    def half_angle(self) -> float:
        """Angle in radians from the septum's middle to the free wall's outside, at the base."""
        return float(self.foot(np.ones(1), np.ones(1), np.ones(1))[1][0])

    def foot(self, xi: np.ndarray, eta: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ``r, phi`` on the septum's epicardium, widened for depth ``s``."""
        return self._widen(*_half_disc(xi, eta), s)

    def sheet(self, xi: np.ndarray, eta: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the point of the free wall in mm, (..., 3)."""
        across, down = _half_disc(xi, eta)
        rho = np.hypot(across, down)
        along = np.sinc(0.5 * rho) * 0.5 * np.pi  # sin(pi rho / 2) / rho: even steps along the arc
        r, phi = self._widen(along * across, along * down, s)
        lift = (self.right.bulge + s * self.right.thickness) * np.cos(0.5 * np.pi * rho)
        outwards = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=-1)
        return self._epicardium(r, phi) + lift[..., None] * outwards

    def _widen(
        self, across: np.ndarray, down: np.ndarray, s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ``r, phi`` of points in the half disc, its edge moved out by ``s`` thicknesses."""
        thickness = s * self.right.thickness
        step = np.array([-5e-5, 5e-5])
        below, above = self._epicardium(self.right.apex + step, np.zeros(2))
        start = self.right.apex - thickness * np.ptp(step) / np.linalg.norm(above - below)
        r = 1.0 - (1.0 - start) * down
        around = self._epicardium(r, np.zeros_like(r))[..., 0]
        return r, (np.radians(self.right.half_angle) + thickness / around) * across

    def _epicardium(self, r: np.ndarray, phi: np.ndarray) -> np.ndarray:
        return self.left.position(r, phi, np.ones_like(r))


def _half_disc(xi: np.ndarray, eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``across`` and ``down`` in the half disc, the image of a rectangle ``xi``, ``eta``.

    A sheet over a rectangle would lie flat in its corners; on the disc's edge it stands up
    everywhere. Squares go to circles (Shirley and Chiu 1997), so a triangle in a corner stays a
    triangle.
    """
    down = 1.0 - eta
    wide = np.abs(xi) > down
    rho = np.where(wide, np.abs(xi), down)
    share = np.divide(np.where(wide, down, np.abs(xi)), rho, out=np.zeros_like(rho), where=rho > 0)
    turn = 0.25 * np.pi * np.where(wide, share, 2.0 - share)  # from the diameter
    return np.sign(xi) * rho * np.cos(turn), rho * np.sin(turn)


def biventricle(
    left: EllipsoidalWall = HUMAN,
    right: RightVentricle = RightVentricle(),
    rings: int = 15,
    around: int = 32,
    layers: tuple[int, int] = (3, 2),
    order: int = 1,
    grading: float = 1.0,
) -> Mesh:
    """Return the mesh of both ventricles; the right one lies towards positive x.

    Parameters
    ----------
    left, right : the dimensions of the ventricles.
    rings, around, grading : of the left ventricle, as in
        :func:`~emulator.geometry.generators.ellipsoid.truncated_ellipsoid`.
    layers : the number of layers through the left wall and through the right free wall.
    order : 1, or 2 for quadratic elements with their mid-edge nodes on the true surfaces.

    Returns
    -------
    Mesh with node set base and facet sets lv_endocardium, rv_endocardium, epicardium, base.
    """
    if min(layers) < 1:
        raise InputError(f"biventricle: {layers} layers through the walls; expected at least 1")
    through, strips = layers
    septum = Septum(left, right)
    opened, on_base, in_disc, in_septum = _open_disc(septum, rings, around, strips, grading)
    septal, free = np.unique(opened.inner), np.setdiff1d(opened.inner, opened.line)
    wall = stacked(len(in_disc), through)
    sheet = _sheet_columns(opened, free, wall, strips)
    in_wall, in_sheet = _in_columns(wall, in_disc), _in_columns(sheet[septal], in_septum[septal])
    on_wall = wall_midpoints(left, *in_wall.T)

    def midpoints(edges: np.ndarray) -> np.ndarray:
        of_sheet = (edges >= wall.size).any(axis=1)
        result = np.empty((len(edges), 3))
        result[of_sheet] = septum.sheet(*in_sheet[edges[of_sheet]].mean(axis=1).T)
        result[~of_sheet] = on_wall(edges[~of_sheet])
        return result

    whole = np.concatenate([opened.inner, opened.outer, opened.band])
    base = np.concatenate([wall[on_base].ravel(), sheet[free[on_base[free]]].ravel()])
    surfaces = {
        "lv_endocardium": wall[:, 0],
        "rv_endocardium": np.concatenate([wall[septal, -1], sheet[free, 0]]),
        "epicardium": np.concatenate([wall[np.unique(opened.outer), -1], sheet[free, -1]]),
        "base": base,
    }
    return body(
        np.concatenate([left.position(*in_wall.T), septum.sheet(*in_sheet[wall.size :].T)]),
        np.concatenate([extrude(wall, whole), extrude(sheet, opened.inner)]),
        surfaces,
        {"base": base},
        midpoints,
        order,
    )


def _open_disc(
    septum: Septum, rings: int, around: int, strips: int, grading: float
) -> tuple[Footprint, np.ndarray, np.ndarray, np.ndarray]:
    """Return the disc opened around the septum, which takes half of ``around`` on full rings.

    Also whether each vertex is on the base (v,), and its coordinates ``r``, ``phi`` in the left
    wall and ``xi``, ``eta`` in the septum, each (v, 2); the latter mean nothing outside it. Septum
    and band are in place, the other vertices moved smoothly.
    """
    radius, angle, triangles = disc(rings, around)
    angle = np.angle(np.exp(1j * angle))  # from -pi to pi
    columns, ring = around // 4, -(-around // 6)
    if columns < 2 or ring > rings - 2:
        raise InputError(
            f"biventricle: {rings} rings of {around} leave no grid for the septum; expected at "
            f"least 8 around and {ring + 2} rings"
        )
    half_angle = 2.0 * np.pi * columns / around
    xi, eta = angle / half_angle, (radius * rings - ring) / (rings - ring)
    inside = (np.abs(xi) < 1.0 + 1e-9) & (eta > -1e-9)
    opened = open_sheet(triangles, inside, strips)
    rim = np.flatnonzero((radius == 1.0) & ~inside)
    xi, eta, r, phi = (part[opened.origin] for part in (xi, eta, radius, angle))
    on_base = r == 1.0
    r, eta = toward_base(r, grading), np.where(eta > 0.0, toward_base(eta, grading), eta)
    points = polar(r, phi)
    septal, band = np.unique(opened.inner), opened.levels[:, 1:]
    r[septal], phi[septal] = septum.foot(xi[septal], eta[septal], np.zeros(1))
    r[band], phi[band] = septum.foot(xi[band], eta[band], np.arange(1, strips + 1) / strips)
    share = (np.pi - np.abs(phi[rim])) / (np.pi - half_angle)
    phi[rim] = np.sign(phi[rim]) * (np.pi - share * (np.pi - septum.half_angle))
    fixed = np.concatenate([band[:, -1], rim])
    x, y = spread(points, opened.outer, fixed, polar(r[fixed], phi[fixed])).T
    rest = np.setdiff1d(opened.outer, fixed)
    r[rest], phi[rest] = np.hypot(x[rest], y[rest]), np.arctan2(y[rest], x[rest])
    return opened, on_base, np.column_stack([r, phi]), np.column_stack([xi, eta])


def _sheet_columns(
    opened: Footprint, free: np.ndarray, wall: np.ndarray, strips: int
) -> np.ndarray:
    """Return the columns of nodes (v, strips + 1) of the free wall, -1 off it.

    Along the line that it stands on, its nodes are the left wall's outermost.

    free : the vertices of the free wall that are not on that line.
    wall : the columns of nodes (v, layers + 1) of the left wall.
    """
    sheet = np.full((len(wall), strips + 1), -1)
    sheet[opened.line] = wall[opened.levels, -1]
    sheet[free] = wall.size + np.arange(len(free) * (strips + 1)).reshape(-1, strips + 1)
    return sheet


def _in_columns(columns: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return coordinates (n, 3) of the nodes in ``columns`` (v, layers + 1): a place, and depth.

    They have a row for every number up to the largest, zero for nodes in no column.
    """
    coordinates = np.zeros((columns.max() + 1, 3))
    coordinates[columns, :2] = places[:, None]
    coordinates[columns, 2] = np.arange(columns.shape[1]) / (columns.shape[1] - 1)
    return coordinates
