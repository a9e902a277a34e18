r"""The wall of a left ventricle, meshed between two surfaces: endocardium and epicardium.

Both are cut by the base plane, laid out in the disc and meshed anew with even triangles
(:mod:`emulator.hearts.remeshing`); a flat annulus joins their rims, and Gmsh fills what they
enclose. The long axis is the base plane's normal, from apex to base. Where it is not given it is
the area vector of the rims, :math:`\frac12 \sum_\text{edges} x_a \times x_b`, and the plane lies
as low as the lowest point of a rim, so that rims which are not flat, or not at one height, are cut
off; the result says by how much. Above a plane that is given, a surface may have any openings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.units import IN_MM, MM3_PER_ML
from emulator.geometry.mesh import Mesh, signed_volumes
from emulator.hearts.left_wall import left_wall
from emulator.hearts.remeshing import DiscMap, Unmeshable, triangulate
from emulator.hearts.surfaces import (
    Surface,
    axes_across,
    cut,
    inside,
    one_rim,
    place_of,
    smoothed,
)
from emulator.hearts.wall import (
    Wall,
    distances,
    farthest,
    fill,
    measured,
    mesh_that_fits,
    surface_in_mm,
    thickness_of,
)

_MOST_CUT = 0.2  # of the epicardium's height: rims that stand further apart are no base
_SIZE = 0.7  # of the median thickness: some 5000 quadratic nodes for a human ventricle
_SAME = 1e-3  # of the extent: rims this flat are not cut
_THICK = 20.0, 2.5  # mm and medians; no wall of a left ventricle is thicker than the lesser
_THICK_SHARE = 0.02  # of the wall, above which its thick part is worth a word
_FILLED = 0.1, 4.0  # volumes of a left ventricle's cavity over its wall's lie between


def mesh_wall(
    endocardium: str | Path | Surface,
    epicardium: str | Path | Surface,
    *,
    right: str | Path | Surface | None = None,
    size: float | None = None,
    order: int = 2,
    axis: Sequence[float] | None = None,
    base_height: float | None = None,
    base_point: Sequence[float] | None = None,
    smooth: int = 0,
    unit: str = "mm",
) -> Wall:
    """Mesh the space between two surfaces, closed or open at the base, with tetrahedra.

    Parameters
    ----------
    endocardium, epicardium : files of triangles (STL, PLY, OBJ), or surfaces in mm.
    right : the right ventricle's endocardium where the epicardium wraps both ventricles; the left
        wall ends there (:mod:`emulator.hearts.left_wall`).
    size : the edge length in mm; by default 0.7 of the median thickness, or less where the wall
        is too thin for it.
    order : 2 for quadratic elements with curved edges on both surfaces, or 1.
    axis : the base plane's normal, from apex to base, of any length; found from the rims by
        default. Closed surfaces need it.
    base_height : the height of the base plane, mm along ``axis`` from the coordinates' origin.
    base_point : a point (3,) mm of the plane instead.
    smooth : times of Taubin's filter on both surfaces; 10 to 30 take the steps off surfaces of
        voxels.
    unit : the unit of the files, ``mm``, ``cm``, ``m`` or ``um``; size and base plane are in mm.

    Raises
    ------
    InputError
        A surface that :func:`~emulator.hearts.surfaces.surface` refuses, with holes, or closed
        without a base plane; surfaces that are swapped, apart, or cross; lengths that are not in
        mm; no Gmsh; or a wall too thin for ``size`` mm, or for any.
    """
    if order not in (1, 2):
        raise InputError(f"order {order}: expected 1 or 2")
    look_up(IN_MM, unit, "unit")
    if smooth < 0:
        raise InputError(f"smooth {smooth}: expected 0 times or more")
    intact = [
        surface_in_mm(source, name, unit)
        for source, name in ((endocardium, "endocardium"), (epicardium, "epicardium"))
    ]
    if right is not None:
        left = left_wall(intact[0], intact[1], surface_in_mm(right, "right ventricle", unit))
        intact[1] = left.outside
        if axis is None:
            axis = left.axis.tolist()
            if base_height is None and base_point is None:
                base_height = left.height
    normal, point = _plane(intact, axis, base_height, base_point)
    below = [cut(surface, point, normal) for surface in intact]
    for surface in below:
        rim = surface.points[one_rim(surface)] @ normal
        if rim.min() < point @ normal - _SAME * intact[1].extent:
            raise InputError(
                f"{surface.name}: its opening reaches below the base plane, down to {rim.min():.4g}"
                f" mm along the axis, the plane being at {point @ normal:.4g}; expected a lower "
                "one: --base-height or --base-point"
            )
    height = max(((surface.points - point) @ normal).max() for surface in intact)
    above = (intact[1].volume - below[1].volume) / MM3_PER_ML
    is_cut = height > _SAME * intact[1].extent
    inner, outer = (smoothed(surface, smooth) for surface in below)
    _check_nested(inner, outer, normal)
    thickness = thickness_of(distances(inner.points, [outer]))
    make = partial(_mesh, [DiscMap(inner), DiscMap(outer)], normal, point, order)
    length, before = mesh_that_fits(
        make, thickness, size, _SIZE * thickness.median, intact[1].extent
    )
    wall = measured(
        before,
        below,
        axis=normal,
        base=below[0].points[np.unique(one_rim(below[0]))].mean(axis=0),
        size=length,
        thickness=thickness,
        shift=farthest(inner.points, below[0].points, outer.points, below[1].points),
        cut_off=(float(height), above) if is_cut else (0.0, 0.0),
    )
    return replace(wall, warnings=tuple(_doubts(wall, inner.volume / MM3_PER_ML)))


def _doubts(wall: Wall, smooth_cavity: float) -> Iterator[str]:
    """Yield a sentence per doubt about a wall; ``smooth_cavity`` mL are in the smooth surface."""
    [(cavity, surface_cavity)], (volume, _) = wall.cavities.values(), wall.wall
    _, above = wall.cut_off
    if above > cavity + volume:
        x, y, z = -wall.axis + 0.0
        yield (
            f"the base plane cuts off {above:.4g} mL and leaves {cavity + volume:.4g}: does the "
            f"axis lead from apex to base? The other way round: --axis {x:.4g} {y:.4g} {z:.4g} "
            f"--base-height {-(wall.base @ wall.axis) + 0.0:.4g}"
        )
    limit = min(_THICK[0], _THICK[1] * wall.thickness.median)
    of_elements = wall.local_thickness()[wall.mesh.corners].mean(axis=1)
    volumes = signed_volumes(wall.mesh.nodes, wall.mesh.elements) / MM3_PER_ML
    thick = volumes[of_elements > limit].sum()
    if thick > _THICK_SHARE * volume:
        yield (
            f"{thick:.3g} mL between the surfaces are thicker than {limit:.3g} mm: a right "
            "ventricle? The epicardium should be the left one's"
        )
    low, high = _FILLED
    if not low < cavity / volume < high:
        least = "less" if cavity < low * volume else "more"
        yield (
            f"the cavity is {least} than {low if least == 'less' else high:g} of the wall: are "
            "both surfaces those of one left ventricle?"
        )
    if abs(cavity / smooth_cavity - 1.0) > 0.01:
        remedy = "a smaller --size, or --order 2" if wall.mesh.order == 1 else "a smaller --size"
        yield f"the cavity is more than 1 % off: choose {remedy}"
    elif abs(cavity / surface_cavity - 1.0) > 0.01:
        yield "smoothing made the cavity more than 1 % off: choose fewer times, --smooth"


def _plane(
    surfaces: Sequence[Surface],
    axis: Sequence[float] | None,
    height: float | None,
    point: Sequence[float] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal (3,) and a point (3,) of the base plane."""
    if height is not None and point is not None:
        raise InputError(
            "base plane: give a height or a point, not both (--base-height, --base-point)"
        )
    has_plane = height is not None or point is not None
    # Openings above a plane that is given do not matter, and what is below it is cut first.
    of_rims = [] if has_plane and axis is not None else surfaces
    rims = [(surface, one_rim(surface)) for surface in of_rims if surface.rims or not has_plane]
    normal = np.zeros(3) if axis is None else np.asarray(axis, dtype=float)
    if axis is None:
        if len(rims) < len(surfaces):
            raise InputError(
                "long axis: give it, from apex to base (--axis X Y Z); it is found only where both "
                "surfaces are open at the base"
            )
        ends = [surface.points[edges] for surface, edges in rims]
        for x in ends:
            normal += np.cross(x[:, 0], x[:, 1]).sum(axis=0)
        middle = np.mean([x.mean(axis=(0, 1)) for x in ends], axis=0)
        normal *= np.sign((middle - surfaces[1].points.mean(axis=0)) @ normal)
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
    levels = np.concatenate([surface.points[np.unique(edges)] @ normal for surface, edges in rims])
    tall = np.ptp(surfaces[1].points @ normal)
    if np.ptp(levels) > _MOST_CUT * tall:
        raise InputError(
            f"base: the rims lie {np.ptp(levels):.4g} mm apart along the long axis, of {tall:.4g} "
            "mm in all; give the base plane (--base-height or --base-point), or --axis"
        )
    flat = np.ptp(levels) < _SAME * surfaces[1].extent
    return normal, (levels.mean() if flat else levels.min()) * normal


def _check_nested(endocardium: Surface, epicardium: Surface, axis: np.ndarray) -> None:
    """Raise :class:`InputError` unless the first lies within the second."""
    within = inside(epicardium, endocardium.points, axis)
    outer = inside(endocardium, epicardium.points, axis)
    if within.all() and not outer.any():
        return
    if outer.mean() > 0.5:
        raise InputError(
            "endocardium and epicardium are swapped: the epicardium lies within the endocardium"
        )
    if not within.any():
        raise InputError(
            "the endocardium lies outside of the epicardium: its middle is at "
            f"{place_of(endocardium.points.mean(axis=0))}, the other's at "
            f"{place_of(epicardium.points.mean(axis=0))}"
        )
    bad = endocardium.points[~within] if not within.all() else epicardium.points[outer]
    raise InputError(
        f"the surfaces cross: {int((~within).sum())} of the endocardium's {len(within)} points lie "
        f"outside of the epicardium, {int(outer.sum())} of the epicardium's inside, around "
        f"{place_of(bad.mean(axis=0))}; repair them there"
    )


def _mesh(
    maps: Sequence[DiscMap], normal: np.ndarray, point: np.ndarray, order: int, size: float
) -> Mesh:
    """Return the wall between two surfaces, the inner one first, with flat rims in one plane."""
    new = [disc_map.remeshed(size) for disc_map in maps]
    inner, outer = (triangulation.surface for triangulation in new)
    outside = ~inside(outer, inner.points, normal)
    within = inside(inner, outer.points, normal)
    if (bad := np.concatenate([inner.points[outside], outer.points[within]])).size:
        raise Unmeshable(f"the wall is too thin for edges of {size:.3g} mm at {place_of(bad[0])}")
    frame, count = axes_across(normal), len(inner.points)
    loops = [count + new[1].loops[0], new[0].loops[0]]
    points = np.vstack([inner.points, outer.points])
    flat, annulus = triangulate([(points[loop] - point) @ frame.T for loop in loops], size)
    on_rims = sum(map(len, loops))
    new_ones = np.arange(len(points), len(points) + len(flat) - on_rims)
    base = np.concatenate([*loops, new_ones])[annulus]
    more = point + flat[on_rims:] @ frame
    return fill(maps, new, {"base": base}, more, normal, size, order)
