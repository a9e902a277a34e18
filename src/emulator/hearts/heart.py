r"""The walls of a left ventricle, or of both, meshed between endocardia and epicardium.

Surfaces are smoothed, laid out in the disc and meshed anew with even triangles
(:mod:`emulator.hearts.remeshing`); joints close the space between their rims
(:mod:`emulator.hearts.joints`), and Gmsh fills it. Of both ventricles the septum is what lies
between the endocardia.

The surfaces end at their valves, or are cut by a base plane, as those of a left ventricle always
are. The long axis is the base plane's normal, from apex to base. Where it is not given it is the
area vector of the rims, :math:`\frac12 \sum_\text{edges} x_a \times x_b`, and the plane lies as low
as the lowest point of a rim, so that rims which are not flat, or not at one height, are cut off;
the result says by how much. Above a plane that is given, a surface may have any openings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.units import IN_MM, MM3_PER_ML
from emulator.geometry.fibres import BOTH
from emulator.hearts.checks import check_places, check_sides, doubts, mirrored
from emulator.hearts.joints import (
    LEAST,
    joints_of,
    mesh_between,
    thickened,
    without_edge,
)
from emulator.hearts.left_wall import left_wall
from emulator.hearts.remeshing import DiscMap
from emulator.hearts.splitting import split_muscle
from emulator.hearts.surfaces import (
    Surface,
    axis_to_rims,
    cut,
    distances,
    one_rim,
    place_of,
    rim_loops,
    smoothed,
)
from emulator.hearts.wall import (
    Wall,
    farthest,
    measured,
    mesh_that_fits,
    surface_in_mm,
    thickness_of,
)

VENTRICLES = ("both", "left")
_MOST_CUT = 0.2  # of the epicardium's height: rims that stand further apart are no base
_SIZE = 0.7  # of a left wall's median thickness: some 5000 quadratic nodes for a human ventricle
_SQUARES = 1200  # of the edges' length that have the area of all surfaces: some 10 000 nodes
_LARGE, _RODENT = 100.0, 25.0  # mm, extents of hearts that are as large as ours, and of a rat's
_SAME = 1e-3  # of the extent: rims this flat are not cut

Source = str | Path | Surface


def mesh_wall(
    endocardium: Source,
    epicardium: Source,
    *,
    right: Source | None = None,
    ventricles: str | None = None,
    size: float | None = None,
    order: int = 2,
    axis: Sequence[float] | None = None,
    base_height: float | None = None,
    base_point: Sequence[float] | None = None,
    smooth: int = 0,
    least: float | None = None,
    unit: str = "mm",
) -> Wall:
    """Mesh the wall of a left ventricle, or the walls of both, with tetrahedra.

    A left wall has the facet sets endocardium, epicardium and base. Both have lv_endocardium,
    rv_endocardium and epicardium; base, where the wall ends; and mitral, aortic, tricuspid and
    pulmonary, the parts of it around each valve, or lv_endocardium_base of a ventricle whose
    openings are not told apart.

    Parameters
    ----------
    endocardium, epicardium : files of triangles (STL, PLY, OBJ), or surfaces in mm.
    right : the right ventricle's endocardium, where the epicardium wraps both ventricles.
    ventricles : ``both`` (the default with ``right``), or ``left`` for its wall alone, which ends
        at the right ventricle (:mod:`emulator.hearts.left_wall`).
    size : the edge length in mm; by default 0.7 of a left wall's median thickness, of both
        ventricles for some 10 000 quadratic nodes, or less where a wall is too thin for it.
    order : 2 for quadratic elements with curved edges on the surfaces, or 1.
    axis : the base plane's normal, from apex to base, of any length; found from the rims by
        default. Closed surfaces need it.
    base_height : the height of the base plane, mm along ``axis`` from the coordinates' origin.
    base_point : a point (3,) mm of the plane instead.
    smooth : times of Taubin's filter on all surfaces; 10 to 30 take the steps off surfaces of
        voxels.
    least : the least thickness of the walls of both ventricles, mm; the epicardium is moved to it.
        The default is 2 mm, and in proportion less for hearts below 100 mm from corner to corner.
    unit : the unit of the files, ``mm``, ``cm``, ``m`` or ``um``; other lengths are in mm.

    Raises
    ------
    InputError
        A surface that :func:`~emulator.hearts.surfaces.surface` refuses, with holes, or closed
        without a base plane; openings that do not belong together; surfaces that are swapped,
        apart, or cross; lengths that are not in mm; no Gmsh; or a wall too thin for ``size`` mm,
        or for any.
    """
    _check_options(order, unit, smooth, least, ventricles, right)
    first = "endocardium" if right is None else BOTH[0]
    sources = [(endocardium, first), (right, BOTH[1]), (epicardium, BOTH[2])]
    read = [surface_in_mm(source, name, unit) for source, name in sources if source is not None]
    intact, plane, notes = _walls(read, BasePlane(axis, base_height, base_point), ventricles)
    both, is_cut = len(intact) == 3, plane != BasePlane()
    base = _below(intact, plane) if is_cut or not both else _at_valves(intact)
    *inner, outer = (smoothed(surface, smooth) for surface in base.surfaces)
    check_places([*inner, outer])
    scale = min(1.0, read[-1].extent / _LARGE)
    outside = thickened(outer, inner, least or scale * LEAST) if both else outer
    surfaces = [*inner, without_edge(outside, inner, scale) if both and not is_cut else outside]
    thickness = thickness_of(distances(inner[0].points, surfaces[1:]))
    area = sum(surface.mesh.area for surface in surfaces)
    usual = np.sqrt(area / _SQUARES) if both else _SIZE * thickness.median
    make = partial(mesh_between, [*map(DiscMap, surfaces)], joints_of(surfaces), base.axis, order)
    length, before = mesh_that_fits(make, thickness, size, usual, intact[-1].extent)
    rims = np.concatenate([base.surfaces[0].points[loop] for loop in rim_loops(base.surfaces[0])])
    after = [*inner, outside]
    wall = measured(
        before,
        base.surfaces,
        axis=base.axis,
        base=rims.mean(axis=0),
        size=length,
        thickness=thickness,
        shift=max(farthest(a.points, b.points) for a, b in zip(base.surfaces, after, strict=True)),
        cut_off=base.cut_off,
    )
    volumes = [surface.volume / MM3_PER_ML for surface in inner]
    return replace(wall, warnings=(*notes, *doubts(wall, volumes)))


class BasePlane(NamedTuple):
    """The base plane as far as it is known: axis, height along it, or a point."""

    axis: Sequence[float] | None = None
    height: float | None = None
    point: Sequence[float] | None = None


def _walls(
    surfaces: list[Surface], plane: BasePlane, ventricles: str | None
) -> tuple[list[Surface], BasePlane, list[str]]:
    """Return the surfaces that walls are between, the epicardium last, the base plane, and notes.

    surfaces : the surfaces that were read: endocardium, or both, and epicardium.
    """
    notes: list[str] = []
    extent = surfaces[-1].extent
    if extent < _RODENT:
        notes.append(
            f"the epicardium is {extent:.3g} mm from corner to corner, as a mouse's or a rat's: if "
            "the heart is of neither, give the files' --unit, such as cm"
        )
    if len(surfaces) == 3 or not _are_one(*surfaces):
        check_places(surfaces, crossing=False)
    if len(surfaces) == 3:
        check_sides(*surfaces)
        notes += mirrored(surfaces)
    elif _are_one(*surfaces):
        surfaces, axis = split_muscle(replace(surfaces[0], name="the muscle"), *plane)
        at = round(float((surfaces[-1].points @ axis).max()), 6) + 0.0
        plane = BasePlane(axis.tolist())
        notes.append(
            f"one closed surface has both walls: split at {at:.4g} mm along the axis "
            f"{place_of(axis)}, where it falls into {len(surfaces)} surfaces"
        )
    if len(surfaces) == 3 and ventricles != "left":
        return [replace(s, name=name) for s, name in zip(surfaces, BOTH, strict=True)], plane, notes
    inner, *right, outer = surfaces
    inner = replace(inner, name="endocardium")
    if not right:
        return [inner, replace(outer, name="epicardium")], plane, notes
    left = left_wall(inner, outer, right[0])
    if plane.axis is None:
        at_all = plane.height is not None or plane.point is not None
        plane = BasePlane(left.axis.tolist(), plane.height if at_all else left.height, plane.point)
    return [inner, left.outside], plane, notes


def _are_one(endocardium: Surface, epicardium: Surface) -> bool:
    """Return whether two surfaces are one, and closed."""
    same = endocardium.points.shape == epicardium.points.shape and not endocardium.rims
    return bool(same and np.allclose(endocardium.points, epicardium.points))


def _check_options(
    order: int,
    unit: str,
    smooth: int,
    least: float | None,
    ventricles: str | None,
    right: Source | None,
) -> None:
    """Raise :class:`InputError` for options that are out of range."""
    if order not in (1, 2):
        raise InputError(f"order {order}: expected 1 or 2")
    look_up(IN_MM, unit, "unit")
    if smooth < 0:
        raise InputError(f"smooth {smooth}: expected 0 times or more")
    if least is not None and not least > 0.0:
        raise InputError(f"least {least} mm: expected a thickness above 0 mm")
    if ventricles is not None:
        look_up(dict.fromkeys(VENTRICLES), ventricles, "ventricles")
        if right is None:
            raise InputError(
                f"--ventricles {ventricles}: give the right ventricle's endocardium, --right"
            )


class Base(NamedTuple):
    """Surfaces that end at the base.

    surfaces : the surfaces. axis : (3,) from apex to base, of length 1.
    cut_off : the height in mm and the epicardium's volume in mL above the base plane.
    """

    surfaces: list[Surface]
    axis: np.ndarray
    cut_off: tuple[float, float]


def _at_valves(surfaces: list[Surface]) -> Base:
    """Return surfaces as they are, open at their valves."""
    joints_of(surfaces)
    return Base(surfaces, axis_to_rims(surfaces[0]), (0.0, 0.0))


def _below(surfaces: Sequence[Surface], plane: BasePlane) -> Base:
    """Return what is below the base plane of surfaces, the epicardium last."""
    normal, point = _place(surfaces, plane)
    below, outer = [cut(surface, point, normal) for surface in surfaces], surfaces[-1]
    for surface in below:
        rim = surface.points[one_rim(surface)] @ normal
        if rim.min() < point @ normal - _SAME * outer.extent:
            raise InputError(
                f"{surface.name}: its opening reaches below the base plane, down to {rim.min():.4g}"
                f" mm along the axis, the plane being at {point @ normal:.4g}; expected a lower "
                "one: --base-height or --base-point"
            )
    above = max(float(((surface.points - point) @ normal).max()) for surface in surfaces)
    if above <= _SAME * outer.extent:
        return Base(below, normal, (0.0, 0.0))
    return Base(below, normal, (above, (outer.volume - below[-1].volume) / MM3_PER_ML))


def _place(surfaces: Sequence[Surface], plane: BasePlane) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal (3,) and a point (3,) of the base plane."""
    axis, height, point = plane
    if height is not None and point is not None:
        raise InputError(
            "base plane: give a height or a point, not both (--base-height, --base-point)"
        )
    has_plane, outer = height is not None or point is not None, surfaces[-1]
    # Openings above a plane that is given do not matter, and what is below it is cut first.
    of_rims = [] if has_plane and axis is not None else surfaces
    rims = [
        surface.points[one_rim(surface)] for surface in of_rims if surface.rims or not has_plane
    ]
    if axis is None:
        if len(rims) < len(surfaces):
            raise InputError(
                "long axis: give it, from apex to base (--axis X Y Z); it is found only where both "
                "surfaces are open at the base"
            )
        normal = np.sum([axis_to_rims(surface) for surface in surfaces], axis=0)
    else:
        normal = np.asarray(axis, dtype=float)
    if normal.shape != (3,) or not np.isfinite(normal).all() or not normal.any():
        raise InputError(f"long axis {axis}: expected three numbers, not all zero: --axis X Y Z")
    normal = normal / np.linalg.norm(normal)
    if has_plane:
        place = height * normal if height is not None else np.asarray(point, dtype=float)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise InputError(
                f"base plane {height if point is None else point}: expected a finite height, "
                "--base-height, or three numbers, --base-point X Y Z"
            )
        return normal, place
    levels = np.concatenate([(edges @ normal).ravel() for edges in rims])
    tall = np.ptp(outer.points @ normal)
    if np.ptp(levels) > _MOST_CUT * tall:
        raise InputError(
            f"base: the rims lie {np.ptp(levels):.4g} mm apart along the long axis, of {tall:.4g} "
            "mm in all; give the base plane (--base-height or --base-point), or --axis"
        )
    flat = np.ptp(levels) < _SAME * outer.extent
    return normal, (levels.mean() if flat else levels.min()) * normal
