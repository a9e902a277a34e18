"""What surfaces and walls of a heart cannot be, and what is doubtful about them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.core.units import MM3_PER_ML
from emulator.geometry.mesh import signed_volumes
from emulator.hearts.surfaces import (
    Surface,
    axis_to_rims,
    distances,
    inside,
    place_of,
    rim_loops,
)
from emulator.hearts.wall import Wall

_MARGIN = 0.015  # of the extent, from rims: where surfaces meet, round-off decides
_OTHER_UNIT = 4.0  # ratio of extents that no two walls of one heart have
_SAME = 0.01  # of the extent: surfaces nearer to each other, but for a tenth, are one
_CLEARLY = 0.3  # cosine, above which a direction is clear
_THICK = 20.0, 2.5  # mm and medians; no wall of a left ventricle is thicker than the lesser
_THICK_SHARE = 0.02  # of the wall, above which its thick part is worth a word
_FILLED = 0.1, 4.0  # volumes of a left ventricle's cavity over its wall's lie between


def check_places(surfaces: Sequence[Surface], *, crossing: bool = True) -> None:
    """Raise :class:`InputError` unless endocardia lie beside each other in the epicardium, last.

    crossing : whether surfaces must not cross; what is above a base plane may.
    """
    outer = surfaces[-1]
    for one, other in combinations(surfaces, 2):
        small, large = sorted((one, other), key=lambda surface: surface.extent)
        if _OTHER_UNIT * small.extent < large.extent:
            raise InputError(
                f"{small.name} is {small.extent:.3g} mm from corner to corner, {large.name} "
                f"{large.extent:.3g} mm; give surfaces of one heart, in one unit"
            )
        if np.quantile(distances(one.points, [other]), 0.9) < _SAME * outer.extent:
            raise InputError(f"{one.name} and {other.name} are one surface; give one of each wall")
    for one, other, where in crossings(surfaces):
        points = astray(one, other, where, _MARGIN * outer.extent)
        share = len(points) / len(one.points)
        if share > 0.5 and one is outer:
            raise InputError(
                f"{other.name} and {one.name} are swapped: the latter lies within the former"
            )
        if share > 0.9:
            raise InputError(
                f"{one.name} lies {where} of {other.name}: its middle is at "
                f"{place_of(one.points.mean(axis=0))}, the other's at "
                f"{place_of(other.points.mean(axis=0))}"
            )
        if len(points) and crossing:
            raise InputError(
                f"{one.name} crosses {other.name}: {len(points)} of its {len(one.points)} points "
                f"are {where}, around {place_of(points.mean(axis=0))}; repair them there"
            )


def crossings(surfaces: Sequence[Surface]) -> Iterator[tuple[Surface, Surface, str]]:
    """Yield pairs of surfaces, the epicardium last, and where the first one must not be."""
    *inner, outer = surfaces
    yield from ((outer, surface, "inside") for surface in inner)
    for surface in inner:
        yield surface, outer, "outside"
        yield from ((surface, other, "inside") for other in inner if other is not surface)


def astray(surface: Surface, other: Surface, where: str, margin: float) -> np.ndarray:
    """Return the points (k, 3) mm of a surface that are ``inside`` or ``outside`` of another.

    margin : mm, distance from the rims within which points do not count.
    """
    rims = [surface.points[loop] for loop in rim_loops(surface)]
    points = surface.points
    if rims:
        ways = cKDTree(np.concatenate(rims), balanced_tree=False).query(points)[0]
        points = points[ways > margin]
    return points[inside(other, points) == (where == "inside")]


def check_sides(left: Surface, right: Surface, outer: Surface) -> None:
    """Raise :class:`InputError` if the right endocardium is the left ventricle's.

    The left ventricle is round and its wall thick; the right one wraps it, and its wall is thin.
    """
    swapped = (
        roundness(left) < roundness(right),
        _free_wall(left, right, outer) < _free_wall(right, left, outer),
    )
    if all(swapped):
        raise InputError(
            f"{left.name} and {right.name} are swapped: the left ventricle is the round one, with "
            "the thicker wall"
        )


def roundness(surface: Surface) -> float:
    """Return the enclosed volume over that of the convex hull."""
    return float(surface.volume / surface.mesh.convex_hull.volume)


def _free_wall(surface: Surface, other: Surface, outer: Surface) -> float:
    """Return the median thickness in mm of the wall that is not the septum."""
    ways = distances(surface.points, [outer])
    free = ways[ways < distances(surface.points, [other])]
    return float(np.median(free)) if len(free) else 0.0


def mirrored(surfaces: Sequence[Surface]) -> Iterator[str]:
    """Yield a sentence if the valves of left and right endocardium lie as in a mirrored heart.

    Seen from the apex to the base, with the right ventricle on the right, both ventricles' outlets
    (the shorter rims) lie before their inlets in every heart; a mirrored one has them behind.
    """
    left, right = surfaces[:2]
    forward = np.cross(axis_to_rims(left), right.points.mean(axis=0) - left.points.mean(axis=0))
    loops = [rim_loops(surface) for surface in (left, right)]
    if min(map(len, loops)) < 2:
        return
    cosines = []
    for surface, (inlet, outlet, *_) in zip((left, right), loops, strict=True):
        way = surface.points[outlet].mean(axis=0) - surface.points[inlet].mean(axis=0)
        cosines.append(way @ forward / np.linalg.norm(way) / np.linalg.norm(forward))
    if max(cosines) < -_CLEARLY:
        yield (
            "the valves lie as in a mirrored heart, whose fibres by rule have the wrong hand: is "
            "one coordinate of the surfaces reversed (x of LPS and RAS)?"
        )


def doubts(wall: Wall, smooth_cavities: Sequence[float]) -> Iterator[str]:
    """Yield a sentence for each doubt about a wall.

    smooth_cavities : the volumes in mL that the surfaces enclose after smoothing.
    """
    volume, is_left = wall.wall[0], len(wall.cavities) == 1
    cavities = sum(cavity for cavity, _ in wall.cavities.values())
    _, above = wall.cut_off
    if above > cavities + volume:
        x, y, z = -wall.axis + 0.0
        yield (
            f"the base plane cuts off {above:.4g} mL and leaves {cavities + volume:.4g}: does the "
            f"axis lead from apex to base? The other way round: --axis {x:.4g} {y:.4g} {z:.4g} "
            f"--base-height {-(wall.base @ wall.axis) + 0.0:.4g}"
        )
    if is_left:
        yield from _doubts_of_left(wall)
    for (cavity, surface_cavity), smooth in zip(
        wall.cavities.values(), smooth_cavities, strict=True
    ):
        if abs(cavity / smooth - 1.0) > 0.01:
            remedy = (
                "a smaller --size, or --order 2" if wall.mesh.order == 1 else "a smaller --size"
            )
            yield f"the cavity is more than 1 % off: choose {remedy}"
        elif abs(cavity / surface_cavity - 1.0) > 0.01:
            yield "smoothing made the cavity more than 1 % off: choose fewer times, --smooth"


def _doubts_of_left(wall: Wall) -> Iterator[str]:
    """Yield a sentence for each doubt that the wall is one of a left ventricle."""
    [(cavity, _)], (volume, _) = wall.cavities.values(), wall.wall
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
