r"""What surfaces of image frames cannot be: each is judged beside the body and its frame's others.

**Alone.** The distances d along normals n at points x, about their middle, are fitted by a shift t,
a turn w and a growth g,

.. math:: d \approx n \cdot (t + w \times x + g\, x) .

The distances of a heart's frames leave a small remainder; those of a mirrored surface or of another
wall, a large one. A heart is held: its surfaces do not all shift or turn far.

**Together.** Surfaces of one frame do not cross. The wall between them keeps its volume, and the
septum its thickness, but for what contraction changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple, cast

import numpy as np

from calibrate.measurements.collection import Observations
from calibrate.measurements.surface import SurfacePoints
from calibrate.state_names import split
from emulator.core.units import IN_ML
from emulator.geometry.facets import encloses, flat_triangles
from emulator.geometry.fibres import BOTH
from emulator.geometry.mesh import Mesh
from emulator.hearts.checks import astray, crossings
from emulator.hearts.surfaces import Surface, distances, surface

EPICARDIUM = BOTH[-1]
_MISSING = 0.2  # of the points, above which it is worth a word
_LEFT = 0.03  # of the body's size, distances that are left by the fit
_SHIFT, _SHIFT_OF_GROWTH = 0.028, 0.2  # of the size: valves come down while a heart contracts
_TURN = 11.0  # degrees
_DETERMINED = 0.3  # of the largest singular value: a body of revolution may turn about its axis
_CROSSING = 0.005  # of the size
_MARGIN = 0.02  # of the size, from rims: surfaces meet there
_VOLUMES = 3.0  # of an endocardium's volume over the body's, or the reverse
_WALL = 0.75, 1.3  # of a frame's wall volume over the body's
_SEPTUM = 0.68, 1.45  # of its thickness over the body's, at its thin end
_STROKES = 0.3  # of a cavity, by which changes of two cavities may differ
_THIN = 0.05  # quantile of distances between endocardia that is the septum's thin end


class Fit(NamedTuple):
    """Shift (mm), turn (degrees) and growth in distances, and what they leave (rms, mm)."""

    shift: float
    turn: float
    growth: float
    left: float


def fit_motion(part: SurfacePoints, ways: np.ndarray) -> Fit:
    """Return the motion in distances (d,) mm along the normals of points, some of them NaN."""
    known = np.isfinite(ways)
    x, n = part.points - part.points.mean(axis=0), part.normals
    radius = np.sqrt(np.mean(np.sum(x**2, axis=1)))
    columns = n, np.cross(x, n) / radius, np.sum(x * n, axis=1)[:, None] / radius
    design = np.hstack(columns)[known]
    solution = np.linalg.pinv(design, rcond=_DETERMINED) @ ways[known]
    left = ways[known] - design @ solution
    turn = np.degrees(np.linalg.norm(solution[3:6]) / radius)
    return Fit(
        shift=float(np.linalg.norm(solution[:3])),
        turn=float(turn),
        growth=float(solution[6] / radius),
        left=float(np.sqrt(np.mean(left**2))),
    )


def frame_doubts(
    mesh: Mesh, surfaces: Mapping[str, Surface], observe: Observations, data: Mapping[str, Any]
) -> Iterator[str]:
    """Yield a sentence for each doubt about surfaces of frames and what became of them.

    Parameters
    ----------
    mesh : the body at rest.
    surfaces : the surface of a frame by facet set and load state.
    observe, data : what :func:`~calibrate.measurements.frames.frame_data` made of them.
    """
    states: dict[str, dict[str, Surface]] = {}
    for name, frame in surfaces.items():
        facet_set, state = split(name)
        states.setdefault(state, {})[facet_set] = replace(frame, name=name)
        part = cast(SurfacePoints, observe.parts[f"surface:{name}"])
        fit = fit_motion(part, data[f"surface:{name}"])
        missing = int(np.isnan(data[f"surface:{name}"]).sum())
        if missing > _MISSING * len(data[f"surface:{name}"]):
            yield (
                f"{name}: {missing} of {len(data[f'surface:{name}'])} points are missing: lines "
                "along their normals do not meet the surface"
            )
        if fit.left > _LEFT * mesh.size:
            yield (
                f"{name}: its distances are {fit.left:.3g} mm off any shift, turn and growth: is "
                "it mirrored, or of another wall?"
            )
        if fit.shift > (_SHIFT + _SHIFT_OF_GROWTH * abs(fit.growth)) * mesh.size:
            yield f"{name}: shifted by {fit.shift:.3g} mm from the mesh: is it in its place?"
        if fit.turn > _TURN:
            yield f"{name}: turned by {fit.turn:.3g} degrees from the mesh: is it in its place?"
    sets = {name for of_state in states.values() for name in of_state}
    body = {name: _of_body(mesh, name) for name in sets if encloses(mesh, name)}
    for of_state in states.values():
        known = {name: frame for name, frame in of_state.items() if name in body}
        yield from _of_volumes(known, body, data)
        yield from _together(mesh, known, body)


def _of_body(mesh: Mesh, name: str) -> Surface:
    """Return a facet set as a surface."""
    return surface(name, mesh.nodes, flat_triangles(mesh.facet_set(name)))


def _of_volumes(
    surfaces: Mapping[str, Surface], body: Mapping[str, Surface], data: Mapping[str, Any]
) -> Iterator[str]:
    """Yield a sentence for each doubt about what cavities enclose."""
    for name, frame in surfaces.items():
        if name == EPICARDIUM:
            continue
        rims, expected = len(frame.rims), len(body[name].rims)
        if rims != expected:
            yield (
                f"{frame.name}: its volume is not in the data: it has {rims} openings, "
                f"{name} of the mesh {expected}"
            )
        share = frame.volume / body[name].volume
        if not 1.0 / _VOLUMES < share < _VOLUMES:
            yield (
                f"{frame.name}: it encloses {frame.volume * IN_ML['mm3']:.4g} mL, {share:.2g} "
                "times what the mesh does: is it of another wall?"
            )


def _together(
    mesh: Mesh, surfaces: Mapping[str, Surface], body: Mapping[str, Surface]
) -> Iterator[str]:
    """Yield a sentence for each doubt about surfaces of one frame beside each other."""
    names = sorted(surfaces, key=lambda name: body[name].volume)
    frame, rest = ([of[name] for name in names] for of in (surfaces, body))
    outside = EPICARDIUM in names
    pairs = crossings(frame) if outside else ((a, b, "inside") for a, b in combinations(frame, 2))
    for one, other, where in pairs:
        points = astray(one, other, where, _MARGIN * mesh.size)
        depth = other.nearest(points)[1].max() if len(points) else 0.0
        if depth > _CROSSING * mesh.size:
            yield (
                f"{one.name} is up to {depth:.3g} mm {where} of {other.name}: are they of one "
                "frame, and in one place?"
            )
    alike = all(len(a.rims) == len(b.rims) for a, b in zip(frame, rest, strict=True))
    of_frame = ", ".join(surface.name for surface in frame)
    whole = {name for name in (*BOTH, "endocardium") if name in mesh.facet_sets}
    if outside and alike and {*names} == whole:
        walls = [of[-1].volume - sum(s.volume for s in of[:-1]) for of in (frame, rest)]
        if not _WALL[0] < walls[0] / walls[1] < _WALL[1]:
            now, before = (wall * IN_ML["mm3"] for wall in walls)
            yield (
                f"the wall between {of_frame} has {now:.4g} mL, of {before:.4g} in the mesh, and "
                "muscle keeps its volume: are they of one frame?"
            )
    if len(names) - outside == 2:
        thick = [np.quantile(distances(of[0].points, [of[1]]), _THIN) for of in (frame, rest)]
        if not _SEPTUM[0] < thick[0] / thick[1] < _SEPTUM[1]:
            yield (
                f"the septum between {frame[0].name} and {frame[1].name} is {thick[0]:.3g} mm "
                f"thick, of {thick[1]:.3g} in the mesh: are they of one frame?"
            )
        strokes = [(a.volume - b.volume) * IN_ML["mm3"] for a, b in zip(frame, rest, strict=True)]
        if abs(strokes[0] - strokes[1]) > _STROKES * rest[1].volume * IN_ML["mm3"]:
            yield (
                f"{frame[0].name} has {strokes[0]:+.3g} mL beside the mesh, {frame[1].name} "
                f"{strokes[1]:+.3g}, and ventricles fill and empty alike: are they of one frame?"
            )
