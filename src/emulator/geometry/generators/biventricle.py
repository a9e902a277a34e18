"""Idealised heart of two ventricles: a truncated ellipsoid with a pouch on its side.

The free wall of the right ventricle stands on the left one's epicardium. There the epicardium's
mesh is opened along the septum's edge, and the sides of the free wall fill the gap: the two walls
share nodes and facets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body
from emulator.geometry.generators.disc import disc
from emulator.geometry.generators.ellipsoid import (
    HUMAN,
    EllipsoidalWall,
    toward_base,
    wall_midpoints,
)
from emulator.geometry.generators.footprint import Footprint, open_sheet, spread
from emulator.geometry.generators.prisms import extrude, stacked
from emulator.geometry.generators.right_ventricle import RightVentricle, Septum
from emulator.geometry.mesh import Mesh
from emulator.geometry.quadratic import Midpoints


def biventricle(
    left: EllipsoidalWall = HUMAN,
    right: RightVentricle = RightVentricle(),
    rings: int = 15,
    around: int = 32,
    layers: tuple[int, int] = (3, 2),
    order: int = 1,
    grading: float = 1.0,
) -> Mesh:
    """Both ventricles; the right one lies towards positive x.

    Parameters
    ----------
    left, right : dimensions.
    rings, around, grading : of the left ventricle, as in
        :func:`~emulator.geometry.generators.ellipsoid.truncated_ellipsoid`.
    layers : through the left wall and through the right free wall.
    order : 1, or 2 for quadratic elements with their mid-edge nodes on the true surfaces.

    Returns
    -------
    Mesh with node set base and facet sets lv_endocardium, rv_endocardium, epicardium, base.
    """
    if min(layers) < 1:
        raise InputError(f"biventricle: {layers} layers through the walls; expected at least 1")
    through, strips = layers
    septum = Septum(left, right)
    flat = _laid_out(septum, rings, around, strips, grading)
    wall = stacked(len(flat.r), through)
    in_wall = _in_columns(wall, flat.r, flat.phi)
    sheet, in_sheet = _sheet(flat, wall, strips)
    opened, free = flat.opened, flat.free
    elements = np.concatenate(
        [
            extrude(wall, np.concatenate([opened.inner, opened.outer, opened.band])),
            extrude(sheet, opened.inner),
        ]
    )
    base = np.concatenate([wall[flat.base].ravel(), sheet[free[flat.base[free]]].ravel()])
    surfaces = {
        "lv_endocardium": wall[:, 0],
        "rv_endocardium": np.concatenate([wall[np.unique(opened.inner), -1], sheet[free, 0]]),
        "epicardium": np.concatenate([wall[np.unique(opened.outer), -1], sheet[free, -1]]),
        "base": base,
    }
    return body(
        np.concatenate([left.position(*in_wall.T), septum.sheet(*in_sheet[wall.size :].T)]),
        elements,
        surfaces,
        {"base": base},
        _midpoints(septum, in_wall, in_sheet),
        order,
    )


@dataclass(frozen=True, eq=False)
class _Flat:
    """The opened disc.

    r, phi : coordinates of its vertices in the left wall, each (v,).
    xi, eta : coordinates in the septum, each (v,); meaningless outside it.
    base : (v,) bool, vertices on the base.
    """

    opened: Footprint
    r: np.ndarray
    phi: np.ndarray
    xi: np.ndarray
    eta: np.ndarray
    base: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """Vertices of the septum off the line that the right free wall stands on."""
        return np.setdiff1d(self.opened.inner, self.opened.line)


def _laid_out(septum: Septum, rings: int, around: int, strips: int, grading: float) -> _Flat:
    """The disc opened around the septum, which takes half of ``around`` on every full ring."""
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
    base = r == 1.0
    r, eta = toward_base(r, grading), np.where(eta > 0.0, toward_base(eta, grading), eta)
    r, phi = _made_room(septum, opened, rim, half_angle, xi, eta, r, phi)
    return _Flat(opened, r, phi, xi, eta, base)


def _made_room(
    septum: Septum,
    opened: Footprint,
    rim: np.ndarray,
    half_angle: float,
    xi: np.ndarray,
    eta: np.ndarray,
    r: np.ndarray,
    phi: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """New ``r``, ``phi``: septum and band at their places, the other vertices moved smoothly."""
    points = _polar(r, phi)
    r, phi = r.copy(), phi.copy()
    near, band = np.unique(opened.inner), opened.levels[:, 1:]
    r[near], phi[near] = septum.foot(xi[near], eta[near], np.zeros(1))
    r[band], phi[band] = septum.foot(xi[band], eta[band], _depths(band.shape[1])[1:])
    share = (np.pi - np.abs(phi[rim])) / (np.pi - half_angle)
    phi[rim] = np.sign(phi[rim]) * (np.pi - share * (np.pi - septum.half_angle))
    held = np.concatenate([band[:, -1], rim])
    x, y = spread(points, opened.outer, held, _polar(r[held], phi[held])).T
    rest = np.setdiff1d(opened.outer, held)
    r[rest], phi[rest] = np.hypot(x[rest], y[rest]), np.arctan2(y[rest], x[rest])
    return r, phi


def _sheet(flat: _Flat, wall: np.ndarray, strips: int) -> tuple[np.ndarray, np.ndarray]:
    """The free wall's columns (v, strips + 1) of nodes, -1 outside the septum, and its coordinates.

    Along the line it stands on, its nodes are the left wall's outermost. Coordinates (n, 3) have a
    row for every node of the body, zero off the free wall.
    """
    opened, free = flat.opened, flat.free
    sheet = np.full((len(flat.r), strips + 1), -1)
    sheet[opened.line] = wall[opened.levels, -1]
    sheet[free] = wall.size + np.arange(len(free) * (strips + 1)).reshape(-1, strips + 1)
    near = np.unique(opened.inner)
    return sheet, _in_columns(sheet[near], flat.xi[near], flat.eta[near])


def _in_columns(columns: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Coordinates (n, 3) of nodes in columns (v, layers + 1): ``first``, ``second`` and depth."""
    coordinates = np.zeros((columns.max() + 1, 3))
    coordinates[columns, 0], coordinates[columns, 1] = first[:, None], second[:, None]
    coordinates[columns, 2] = _depths(columns.shape[1] - 1)
    return coordinates


def _midpoints(septum: Septum, in_wall: np.ndarray, in_sheet: np.ndarray) -> Midpoints:
    """Midpoints of edges in the left wall's coordinates, or in the sheet's for sheet edges."""
    on_wall = wall_midpoints(septum.left, *in_wall.T)

    def midpoints(edges: np.ndarray) -> np.ndarray:
        of_sheet = (edges >= len(in_wall)).any(axis=1)
        result = np.empty((len(edges), 3))
        result[of_sheet] = septum.sheet(*in_sheet[edges[of_sheet]].mean(axis=1).T)
        result[~of_sheet] = on_wall(edges[~of_sheet])
        return result

    return midpoints


def _depths(layers: int) -> np.ndarray:
    return np.arange(layers + 1) / layers


def _polar(r: np.ndarray, phi: np.ndarray) -> np.ndarray:
    return np.column_stack([r * np.cos(phi), r * np.sin(phi)])
