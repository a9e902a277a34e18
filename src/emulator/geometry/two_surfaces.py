r"""The wall of a left ventricle, meshed between two surfaces: endocardium and epicardium.

Both are cut by the base plane, laid out in the disc and meshed anew with even triangles
(:mod:`emulator.geometry.remeshing`); a flat annulus joins their rims, and Gmsh fills what they
enclose. The long axis is the base plane's normal, from apex to base. Where it is not given it is
the area vector of the rims, :math:`\frac12 \sum_\text{edges} x_a \times x_b`, and the plane lies
as low as the lowest point of a rim, so that rims which are not flat, or not at one height, are cut
off; the result says by how much. Above a plane that is given, a surface may have any openings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from emulator.core.errors import InputError, look_up
from emulator.geometry.discretisation import MeshQuality, discretise, mesh_quality
from emulator.geometry.facets import MM3_PER_ML, Cavity
from emulator.geometry.left_wall import left_wall
from emulator.geometry.mesh import SIDES, Mesh, find_rows, orient, signed_volumes
from emulator.geometry.refinement import to_quadratic, unfolded
from emulator.geometry.remeshing import DiscMap, Unmeshable, tetrahedralise, triangulate
from emulator.geometry.surfaces import (
    UNITS,
    Surface,
    axes_across,
    cut,
    inside,
    one_rim,
    place_of,
    read_surface,
    smoothed,
)

_EXTENTS = 4.0, 600.0  # mm; nobody's heart is smaller or larger, a mouse's being 7 mm long
_MOST_CUT = 0.2  # of the epicardium's height: rims that stand further apart are no base
_SIZE = 0.7  # of the median thickness: some 5000 quadratic nodes for a human ventricle
_SAME = 1e-3  # of the extent: rims this flat are not cut
_SMALLER = 1.0, 0.7, 0.5, 0.35  # of the size, tried in turn where a wall is too thin
_THICK = 20.0, 2.5  # mm and medians; no wall of a left ventricle is thicker than the lesser
_THICK_SHARE = 0.02  # of the wall, above which its thick part is worth a word
_FILLED = 0.1, 4.0  # volumes of a left ventricle's cavity over its wall's lie between


class Thickness(NamedTuple):
    """Distance from the endocardium's points to the epicardium, mm."""

    least: float
    median: float
    most: float


@dataclass(frozen=True, eq=False)
class Wall:
    """A meshed wall, and measurements of it.

    mesh : facet and node sets endocardium, epicardium and base, and the node sets
        apex_endocardium and apex_epicardium of one node each; at the surfaces' own place.
    axis : (3,) from apex to base, of length 1. base : (3,) mm, the middle of the cavity's rim.
    size : the target edge length, mm. thickness : the thickness of the wall.
    cavity, wall : the volumes in mL, of the mesh and of the surfaces below the base plane.
    cut_off : the height in mm and the epicardium's volume in mL above the base plane.
    moved : the largest displacement of a point by smoothing, mm.
    folded : the number of elements that were folded, and the largest displacement in mm of a node
        that unfolded them.
    warnings : what is doubtful, a line each.
    """

    mesh: Mesh
    axis: np.ndarray
    base: np.ndarray
    size: float
    thickness: Thickness
    cavity: tuple[float, float]
    wall: tuple[float, float]
    cut_off: tuple[float, float]
    moved: float
    folded: tuple[int, float]
    warnings: tuple[str, ...]
    quality: MeshQuality

    def local_thickness(self) -> np.ndarray:
        """Return the distance (n,) mm to the endocardium plus that to the epicardium, at nodes."""
        nodes = self.mesh.nodes
        walls = (nodes[self.mesh.node_set(name)] for name in ("endocardium", "epicardium"))
        return sum(cKDTree(each, balanced_tree=False).query(nodes)[0] for each in walls)

    def sentences(self) -> list[str]:
        """Return the measurements, a line each."""
        cavity, own = self.cavity
        lines = [
            f"{len(self.mesh.nodes)} nodes, {len(self.mesh.elements)} tetrahedra of order "
            f"{self.mesh.order}, edges of {self.size:.3g} mm",
            f"long axis {place_of(self.axis)}, base at {place_of(self.base)} mm",
            f"wall {self.thickness.least:.3g} to {self.thickness.most:.3g} mm thick, "
            f"median {self.thickness.median:.3g}",
            f"cavity {cavity:.4g} mL, the surface's own {own:.4g} ({100 * (cavity / own - 1):+.2f} "
            f"%); wall {self.wall[0]:.4g} mL, {self.wall[1]:.4g}; cavity over wall "
            f"{cavity / self.wall[0]:.3g}",
        ]
        if self.cut_off[0] > 0.0:
            height, volume = self.cut_off
            lines.append(f"cut off {height:.3g} mm, {volume:.4g} mL, above the base plane")
        if self.moved > 0.0:
            lines.append(f"smoothing moved points by {self.moved:.3g} mm at most")
        if self.folded[0]:
            lines.append(
                f"{self.folded[0]} curved elements were folded, and straightened: nodes on their "
                f"edges moved by {self.folded[1]:.2g} mm at most"
            )
        return [*lines, *self.warnings, self.quality.sentence()]


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
        wall ends there (:mod:`emulator.geometry.left_wall`).
    size : the edge length in mm; by default 0.7 of the median thickness, or less where the wall
        is too thin for it.
    order : 2 for quadratic elements with curved edges on both surfaces, or 1.
    axis : the base plane's normal, from apex to base, of any length; found from the rims by
        default. Closed surfaces need it.
    base_height : the height of the base plane, mm along ``axis`` from the coordinates' origin.
    base_point : a point (3,) mm of the plane instead.
    smooth : times of Taubin's filter on both surfaces; 10 to 30 take the steps off surfaces of
        voxels.
    unit : the unit of the files, ``mm``, ``cm`` or ``m``; size and base plane are in mm.

    Raises
    ------
    InputError
        A surface that :func:`~emulator.geometry.surfaces.surface` refuses, with holes, or closed
        without a base plane; surfaces that are swapped, apart, or cross; lengths that are not in
        mm; no Gmsh; or a wall too thin for ``size`` mm, or for any.
    """
    if order not in (1, 2):
        raise InputError(f"order {order}: expected 1 or 2")
    look_up(UNITS, unit, "unit")
    if smooth < 0:
        raise InputError(f"smooth {smooth}: expected 0 times or more")
    intact = [
        _surface(source, name, unit)
        for source, name in ((endocardium, "endocardium"), (epicardium, "epicardium"))
    ]
    if right is not None:
        left = left_wall(intact[0], intact[1], _surface(right, "right ventricle", unit))
        intact[1] = left.outside
        if axis is None:
            axis = left.axis.tolist()
            if base_height is None and base_point is None:
                base_height = left.height
    normal, point = _plane(intact, axis, base_height, base_point)
    below = [cut(each, point, normal) for each in intact]
    for each in below:
        rim = each.points[one_rim(each)] @ normal
        if rim.min() < point @ normal - _SAME * intact[1].extent:
            raise InputError(
                f"{each.name}: its opening reaches below the base plane, down to {rim.min():.4g} "
                f"mm along the axis, the plane being at {point @ normal:.4g}; expected a lower "
                "one: --base-height or --base-point"
            )
    height = max(((each.points - point) @ normal).max() for each in intact)
    above = (intact[1].volume - below[1].volume) / MM3_PER_ML
    is_cut = height > _SAME * intact[1].extent
    inner, outer = (smoothed(each, smooth) for each in below)
    _check_nested(inner, outer, normal)
    thickness = _thickness(inner, outer)
    target = _SIZE * thickness.median if size is None else size
    if not 0.0 < target < intact[1].extent / 4.0:
        raise InputError(
            f"--size {target} mm: expected edges above 0 and below a quarter of the epicardium's "
            f"extent, {intact[1].extent:.4g} mm"
        )
    maps = [DiscMap(inner), DiscMap(outer)]
    length, before = _mesh_that_fits(maps, target, order, normal, point)
    if size is not None and length < size:
        raise InputError(
            f"the wall, {thickness.least:.3g} mm where it is thinnest, is too thin for edges of "
            f"{size:.3g} mm: --size {length:.4g} fits"
        )
    mesh, folded = unfolded(before) if order == 2 else (before, 0)
    cavity, whole = (each.volume / MM3_PER_ML for each in below)
    wall = Wall(
        mesh=mesh,
        axis=normal,
        base=below[0].points[np.unique(one_rim(below[0]))].mean(axis=0),
        size=float(length),
        thickness=thickness,
        cavity=(Cavity(mesh, "endocardium").rest, cavity),
        wall=(float(discretise(mesh).weights.sum()) / MM3_PER_ML, whole - cavity),
        cut_off=(float(height), above) if is_cut else (0.0, 0.0),
        moved=_farthest(inner.points, below[0].points, outer.points, below[1].points),
        folded=(folded, _farthest(mesh.nodes, before.nodes)),
        warnings=(),
        quality=mesh_quality(mesh),
    )
    return replace(wall, warnings=tuple(_doubts(wall, inner.volume / MM3_PER_ML)))


def _farthest(*points: np.ndarray) -> float:
    """Return the largest distance in mm between points (n, 3) of each pair of arrays."""
    pairs = zip(points[::2], points[1::2], strict=True)
    return float(max(np.linalg.norm(one - other, axis=1).max() for one, other in pairs))


def _doubts(wall: Wall, smooth_cavity: float) -> Iterator[str]:
    """Yield what is doubtful of a wall, whose smoothed endocardium encloses so many mL."""
    (cavity, own), (volume, _), (_, above) = wall.cavity, wall.wall, wall.cut_off
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
    elif abs(cavity / own - 1.0) > 0.01:
        yield "smoothing made the cavity more than 1 % off: choose fewer times, --smooth"


def _surface(source: str | Path | Surface, name: str, unit: str) -> Surface:
    surface = source if isinstance(source, Surface) else read_surface(source, name, UNITS[unit])
    if not _EXTENTS[0] <= surface.extent <= _EXTENTS[1]:
        raise InputError(
            f"{name}: it is {surface.extent:.3g} mm from corner to corner, lengths being taken as "
            f"{unit}: give the file's own --unit, {', '.join(UNITS)}"
        )
    return surface


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
    rims = [(each, one_rim(each)) for each in of_rims if each.rims or not has_plane]
    normal = np.zeros(3) if axis is None else np.asarray(axis, dtype=float)
    if axis is None:
        if len(rims) < len(surfaces):
            raise InputError(
                "long axis: give it, from apex to base (--axis X Y Z); it is found only where both "
                "surfaces are open at the base"
            )
        for each, edges in rims:
            normal += np.cross(each.points[edges[:, 0]], each.points[edges[:, 1]]).sum(axis=0)
        middle = np.mean([each.points[edges].mean(axis=(0, 1)) for each, edges in rims], axis=0)
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
    levels = np.concatenate([each.points[np.unique(edges)] @ normal for each, edges in rims])
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


def _thickness(endocardium: Surface, epicardium: Surface) -> Thickness:
    corners = epicardium.points[epicardium.triangles]
    middles = 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)
    points = np.vstack([epicardium.points, corners.mean(axis=1), middles])
    distances = cKDTree(points, balanced_tree=False).query(endocardium.points)[0]
    return Thickness(float(distances.min()), float(np.median(distances)), float(distances.max()))


def _mesh_that_fits(
    maps: Sequence[DiscMap], size: float, order: int, normal: np.ndarray, point: np.ndarray
) -> tuple[float, Mesh]:
    """Return the first of ``size`` mm and smaller ones that the wall can be meshed with."""
    for smaller in _SMALLER:
        try:
            return smaller * size, _mesh(maps, smaller * size, order, normal, point)
        except Unmeshable as error:
            reason = error
    raise InputError(
        f"{reason}, nor with edges of {size:.3g} mm or any between: move the surfaces apart there, "
        "or smooth them, --smooth 20"
    ) from reason


def _mesh(
    maps: Sequence[DiscMap], size: float, order: int, normal: np.ndarray, point: np.ndarray
) -> Mesh:
    """Return the wall between two surfaces, the inner one first, with flat rims in one plane."""
    (inner, in_disc), (outer, out_disc) = (each.remeshed(size) for each in maps)
    outside = ~inside(outer, inner.points, normal)
    within = inside(inner, outer.points, normal)
    if (bad := np.concatenate([inner.points[outside], outer.points[within]])).size:
        raise Unmeshable(f"the wall is too thin for edges of {size:.3g} mm at {place_of(bad[0])}")
    frame = axes_across(normal)
    # Points of a rim come first, in its order.
    loops = [each.points[: len(one_rim(each))] for each in (outer, inner)]
    flat, annulus = triangulate([(loop - point) @ frame.T for loop in loops], size)
    outer_rim, inner_rim = map(len, loops)
    count = len(inner.points)
    points = np.vstack([inner.points, outer.points, point + flat[outer_rim + inner_rim :] @ frame])
    new = np.arange(count + len(outer.points), len(points))
    number = np.concatenate([count + np.arange(outer_rim), np.arange(inner_rim), new])
    facets = {
        "endocardium": inner.triangles,
        "epicardium": count + outer.triangles,
        "base": number[annulus],
    }
    nodes, elements = tetrahedralise(points, np.concatenate([*facets.values()]), size)
    sets = {name: np.unique(rows) for name, rows in facets.items()}
    for name in ("endocardium", "epicardium"):
        sets[f"apex_{name}"] = sets[name][[np.argmin(nodes[sets[name]] @ normal)]]
    mesh = Mesh(nodes, orient(nodes, elements), sets, facets)
    if order == 1:
        return mesh

    def midpoints(edges: np.ndarray) -> np.ndarray:
        middle = mesh.nodes[edges].mean(axis=1)
        for name, disc, each, first in (
            ("endocardium", in_disc, maps[0], 0),
            ("epicardium", out_disc, maps[1], count),
        ):
            on = find_rows(edges, facets[name][:, SIDES].reshape(-1, 2)) >= 0
            one, other = (edges[on] - first).T
            middle[on] = each.middles(disc[one], disc[other])
        return middle

    return to_quadratic(mesh, midpoints)
