"""What surfaces and walls of a heart cannot be, and what is doubtful about them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.core.units import MM3_PER_ML
from emulator.geometry.mesh import signed_volumes
from emulator.hearts.surfaces import Surface, distances, inside, place_of, rim_loops
from emulator.hearts.wall import Wall

_MARGIN = 0.015  # of the extent, from rims: where surfaces meet, round-off decides
_SAME = 0.01  # of the extent: surfaces nearer to each other, in the median, are one
_THICK = 20.0, 2.5  # mm and medians; no wall of a left ventricle is thicker than the lesser
_THICK_SHARE = 0.02  # of the wall, above which its thick part is worth a word
_FILLED = 0.1, 4.0  # volumes of a left ventricle's cavity over its wall's lie between


def check_places(surfaces: Sequence[Surface]) -> None:
    """Raise :class:`InputError` unless endocardia lie beside each other in the epicardium, last."""
    *inner, outer = surfaces
    margin = _MARGIN * outer.extent
    for one, other in combinations(surfaces, 2):
        if np.median(distances(one.points, [other])) < _SAME * outer.extent:
            raise InputError(f"{one.name} and {other.name} are one surface; give one of each wall")
    for surface in inner:
        if inside(surface, outer.points).mean() > 0.5:
            raise InputError(
                f"{surface.name} and {outer.name} are swapped: the epicardium lies within it"
            )
        points = _off_rims(surface, margin)
        _check_side(surface, points, ~inside(outer, points), outer, "outside")
        points = _off_rims(outer, margin)
        _check_side(outer, points, inside(surface, points), surface, "inside")
        for other in inner:
            if other is not surface:
                within = inside(other, surface.points)
                _check_side(surface, surface.points, within, other, "inside")


def _off_rims(surface: Surface, margin: float) -> np.ndarray:
    """Return the points (k, 3) that are further than ``margin`` mm from all rims."""
    rims = cKDTree(surface.points[np.concatenate(rim_loops(surface))], balanced_tree=False)
    return surface.points[rims.query(surface.points)[0] > margin]


def _check_side(
    surface: Surface, points: np.ndarray, wrong: np.ndarray, other: Surface, where: str
) -> None:
    """Raise :class:`InputError` if any of the surface's points (k, 3) is on the ``wrong`` side."""
    if wrong.all():
        raise InputError(
            f"{surface.name} lies {where} of {other.name}: its middle is at "
            f"{place_of(surface.points.mean(axis=0))}, the other's at "
            f"{place_of(other.points.mean(axis=0))}"
        )
    if wrong.any():
        raise InputError(
            f"{surface.name} crosses {other.name}: {int(wrong.sum())} of its {len(wrong)} points "
            f"are {where}, around {place_of(points[wrong].mean(axis=0))}; repair them there"
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
