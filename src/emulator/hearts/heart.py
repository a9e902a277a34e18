r"""Both ventricles, meshed between three surfaces: left and right endocardium, and the epicardium.

The septum is what lies between the endocardia. Each opening of an endocardium is a valve, or the
base of a ventricle, and belongs to the nearest opening of the epicardium. There the wall ends in a
ring of triangles between both rims, or, where an opening of the epicardium is around several, in
one patch between all of them.

Surfaces that were fitted to images meet at the valves, and the wall ends in an edge. A ring of the
epicardium, 4 mm wide or less, is cut off there and replaced by one row of triangles. So that the
edge is not too sharp, and no wall too thin, a point y of the epicardium that is less than h from
the nearest point x of an endocardium, of normal n, is moved away from it,

.. math:: y \leftarrow x + h\, m, \qquad m \propto (y - x) + (h - |y - x|)\, n, \qquad
          h = \min(h_0, \tfrac12 r) ,

with the distance r to the rim. Both cavities stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from emulator.core.errors import InputError, look_up
from emulator.core.units import IN_MM
from emulator.geometry.discretisation import mesh_quality
from emulator.geometry.fibres import BOTH
from emulator.geometry.mesh import SIDES, Mesh
from emulator.geometry.refinement import to_linear
from emulator.hearts.remeshing import DiscMap, Unmeshable, rim_loops, triangulate
from emulator.hearts.surfaces import (
    Surface,
    area_vector,
    axes_across,
    axis_to_rims,
    clipped,
    closed,
    inside,
    place_of,
    sampled,
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

LEFT, RIGHT, EPICARDIUM = BOTH
VALVES: Mapping[str, tuple[str, ...]] = {
    LEFT: ("mitral", "aortic"),
    RIGHT: ("tricuspid", "pulmonary"),
}
"""The valves of each ventricle, the longer rim first."""
_SQUARES = 1200  # of the edges' length that have the area of all surfaces: some 10 000 nodes
_RING = 4.0  # mm, width of the ring at a valve where surfaces meet
_LEAST = 2.0  # mm, thickness below which the epicardium is moved
_SLOPE = 0.5  # of the distance to a rim, likewise: the wall ends in no sharper edge than 30 degrees
_BETWEEN = 0.4  # of the way between two valves' rims: nothing is cut off further away
_FINE = 0.25  # of it, between the endocardium's points that it is moved away from
_NARROW = 1.5  # of the edges: what joins rims further apart gets nodes of its own
_ASTRAY = 1.0  # of a rim's radius: further away, an opening of the epicardium is another one
_SAME = 0.01  # of the extent: surfaces nearer to each other, in the median, are one


def mesh_heart(
    endocardium: str | Path | Surface,
    right: str | Path | Surface,
    epicardium: str | Path | Surface,
    *,
    size: float | None = None,
    order: int = 2,
    smooth: int = 0,
    least: float = _LEAST,
    unit: str = "mm",
) -> Wall:
    """Mesh the walls of both ventricles with tetrahedra, open at the valves or at the base.

    The mesh has facet sets lv_endocardium, rv_endocardium and epicardium; base, where the wall
    ends; and mitral, aortic, tricuspid and pulmonary, the parts of it around each valve, or
    lv_endocardium_base of a ventricle whose openings are not told apart.

    Parameters
    ----------
    endocardium, right, epicardium : files of triangles (STL, PLY, OBJ), or surfaces in mm: the left
        and the right ventricle's inside, and the outside of both.
    size : the edge length in mm; by default one with which a human heart has some 10 000 quadratic
        nodes, or less where a wall is too thin for it.
    order : 2 for quadratic elements with curved edges on the surfaces, or 1.
    smooth : times of Taubin's filter on all surfaces.
    least : the least thickness of a wall, mm; the epicardium is moved to where it has it.
    unit : the unit of the files, ``mm``, ``cm``, ``m`` or ``um``.

    Raises
    ------
    InputError
        A surface that :func:`~emulator.hearts.surfaces.surface` refuses, or that is closed;
        openings that do not belong together; surfaces that are swapped, apart, or cross; lengths
        that are not in mm; no Gmsh; or a wall too thin for ``size`` mm, or for any.
    """
    if order not in (1, 2):
        raise InputError(f"order {order}: expected 1 or 2")
    look_up(IN_MM, unit, "unit")
    if smooth < 0 or not least > 0.0:
        raise InputError(f"smooth {smooth}, least {least} mm: expected 0 times or more, above 0 mm")
    originals = [
        surface_in_mm(source, name, unit)
        for source, name in ((endocardium, LEFT), (right, RIGHT), (epicardium, EPICARDIUM))
    ]
    _joints(originals)
    *inner, outer = (smoothed(surface, smooth) for surface in originals)
    _check_places([*inner, outer])
    outside = _away(outer, inner, least)
    surfaces = [*inner, _without_edge(outside, inner)]
    axis = axis_to_rims(originals[0])
    make = partial(_mesh, [*map(DiscMap, surfaces)], _joints(surfaces), axis, order)
    thickness = thickness_of(distances(surfaces[0].points, surfaces[1:]))
    area = sum(surface.area for surface in surfaces)
    length, before = mesh_that_fits(
        make, thickness, size, np.sqrt(area / _SQUARES), originals[2].extent
    )
    rims = np.concatenate([originals[0].points[loop] for loop in rim_loops(originals[0])])
    return measured(
        before,
        originals,
        axis=axis,
        base=rims.mean(axis=0),
        size=length,
        thickness=thickness,
        shift=farthest(
            *(s.points for pair in zip(originals, [*inner, outside], strict=True) for s in pair)
        ),
    )


Joint = list[tuple[int, int]]
"""Openings that the wall ends between: surface and rim of each, the epicardium's first."""


def _joints(surfaces: Sequence[Surface]) -> dict[str, Joint]:
    """Return the openings of inner and outer surface that belong together, by valve or base."""
    loops = [rim_loops(surface) for surface in surfaces]
    for surface, rims in zip(surfaces, loops, strict=True):
        if not rims:
            raise InputError(f"{surface.name}: it is closed; expected it open at valves or base")
    outer = [surfaces[2].points[loop] for loop in loops[2]]
    trees = [cKDTree(rim, balanced_tree=False) for rim in outer]
    joints: dict[int, Joint] = {}
    names: dict[int, str] = {}
    for k, (surface, rims) in enumerate(zip(surfaces[:2], loops[:2], strict=True)):
        if len(rims) > len(VALVES[surface.name]):
            raise InputError(
                f"{surface.name}: it has {len(rims)} openings, the smallest of {len(rims[-1])} "
                f"edges at {place_of(surface.points[rims[-1]].mean(axis=0))}; expected two valves "
                "at most: fill the others"
            )
        for number, loop in enumerate(rims):
            rim = surface.points[loop]
            ways = [tree.query(rim)[0].mean() for tree in trees]
            nearest = int(np.argmin(ways))
            radius = np.sqrt(np.linalg.norm(area_vector(rim)) / np.pi)
            if ways[nearest] > _ASTRAY * radius:
                raise InputError(
                    f"{surface.name}: no opening of the epicardium is at its opening around "
                    f"{place_of(rim.mean(axis=0))}; the nearest is {ways[nearest]:.3g} mm away"
                )
            joints.setdefault(nearest, [(2, nearest)]).append((k, number))
            valves = VALVES[surface.name]
            names[nearest] = valves[number] if len(rims) > 1 else f"{surface.name}_base"
    for number, rim in enumerate(outer):
        if number not in joints:
            raise InputError(
                f"{surfaces[2].name}: neither endocardium has an opening at that around "
                f"{place_of(rim.mean(axis=0))}, of {len(rim)} edges; fill it"
            )
    if len(joints) == 1:
        return {"base": joints[0]}
    return {
        names[n] if len(openings) == 2 else f"{surfaces[openings[1][0]].name}_base": openings
        for n, openings in joints.items()
    }


def _check_places(surfaces: Sequence[Surface]) -> None:
    """Raise :class:`InputError` unless two endocardia lie beside each other in the epicardium."""
    left, right, outer = surfaces
    for one, other in ((left, right), (left, outer), (right, outer)):
        if np.median(distances(one.points, [other])) < _SAME * outer.extent:
            raise InputError(f"{one.name} and {other.name} are one surface; give three")
    up = np.eye(3)[2]
    whole = {surface.name: closed(surface) for surface in surfaces}
    for surface in (left, right):
        if inside(whole[surface.name], outer.points, up).mean() > 0.5:
            raise InputError(
                f"{surface.name} and {outer.name} are swapped: the epicardium lies within it"
            )
        out = ~inside(whole[outer.name], surface.points, up)
        rims = cKDTree(surface.points[np.concatenate(rim_loops(surface))], balanced_tree=False)
        out &= rims.query(surface.points)[0] > _LEAST  # where surfaces meet, round-off decides
        if out.all():
            raise InputError(
                f"{surface.name} lies outside of the epicardium: its middle is at "
                f"{place_of(surface.points.mean(axis=0))}"
            )
        if out.any():
            raise InputError(
                f"{surface.name} crosses the epicardium: {int(out.sum())} of its points are outside"
                f", around {place_of(surface.points[out].mean(axis=0))}; repair them there"
            )
    for surface, other in ((left, right), (right, left)):
        within = inside(whole[other.name], surface.points, up)
        if within.any():
            raise InputError(
                f"{surface.name} crosses {other.name}: {int(within.sum())} of its points are inside"
                f", around {place_of(surface.points[within].mean(axis=0))}; repair them there"
            )


def _away(outer: Surface, inner: Sequence[Surface], least: float) -> Surface:
    """Return the epicardium with its points at least ``least`` mm from both endocardia."""
    places, normals = (
        np.vstack([sampled(surface, values(surface), _FINE * least) for surface in inner])
        for values in (lambda surface: surface.points, lambda surface: surface.normals)
    )
    rims = np.vstack([surface.points[loop] for surface in inner for loop in rim_loops(surface)])
    to_rim = cKDTree(rims, balanced_tree=False).query(outer.points)[0]
    h = np.minimum(least, _SLOPE * to_rim)
    distance, nearest = cKDTree(places, balanced_tree=False).query(outer.points)
    near = distance < h
    x, d, h = places[nearest[near]], distance[near, None], h[near, None]
    away = outer.points[near] - x + (h - d) * normals[nearest[near]]
    points = outer.points.copy()
    points[near] = x + h * away / np.linalg.norm(away, axis=1, keepdims=True)
    return Surface(outer.name, points, outer.triangles)


def _without_edge(outer: Surface, inner: Sequence[Surface]) -> Surface:
    """Return the epicardium without a ring at each of its rims that meets an endocardium's rim.

    The ring is narrower where rims are so near to each other that little would be left between.
    """
    rims = np.vstack([surface.points[loop] for surface in inner for loop in rim_loops(surface)])
    loops = rim_loops(outer)
    trees = [cKDTree(outer.points[loop], balanced_tree=False) for loop in loops]
    pairs = combinations(range(len(loops)), 2)
    between = [trees[k].query(outer.points[loops[other]])[0].min() for k, other in pairs]
    to_rim = cKDTree(rims, balanced_tree=False).query(outer.points)[0]
    meeting = [loop for loop in loops if to_rim[loop].mean() < _LEAST]
    if not meeting:
        return outer
    edges = np.unique(np.sort(outer.triangles[:, SIDES].reshape(-1, 2), axis=1), axis=0)
    lengths = np.linalg.norm(outer.points[edges[:, 0]] - outer.points[edges[:, 1]], axis=1)
    graph = coo_array((lengths, edges.T), shape=(len(outer.points),) * 2).tocsr()
    ways = dijkstra(graph, directed=False, indices=np.concatenate(meeting), min_only=True)
    return clipped(outer, min(_RING, _BETWEEN * min(between, default=np.inf)) - ways)


def _mesh(
    maps: Sequence[DiscMap], joints: Mapping[str, Joint], axis: np.ndarray, order: int, size: float
) -> Mesh:
    """Return the walls between three surfaces, the epicardium last."""
    new = [disc_map.remeshed(size) for disc_map in maps]
    outer, up = closed(new[2].surface), np.eye(3)[2]
    for triangulation, other in ((new[0], new[1]), (new[1], new[0])):
        points = triangulation.surface.points
        rims = cKDTree(points[np.concatenate(triangulation.loops)], balanced_tree=False)
        points = points[rims.query(points)[0] > size]  # a lid may be below a rim's points
        bad = ~inside(outer, points, up) | inside(closed(other.surface), points, up)
        if bad.any():
            raise Unmeshable(
                f"the wall is too thin for edges of {size:.3g} mm at {place_of(points[bad][0])}"
            )
    points = np.vstack([triangulation.surface.points for triangulation in new])
    first = np.cumsum([0, *(len(triangulation.surface.points) for triangulation in new)])
    facets, more = dict[str, np.ndarray](), np.zeros((0, 3))
    for name, openings in joints.items():
        loops = [first[k] + new[k].loops[number] for k, number in openings]
        rims_at = [points[loop] for loop in loops]
        if len(loops) == 2 and directed_hausdorff(*rims_at) < _NARROW * size:
            facets[name] = zipped(points, *loops)
            continue
        facets[name], added = _patch(points, loops, size, len(points) + len(more))
        more = np.vstack([more, added])
    mesh = fill(maps, new, facets, more, axis, size, order)
    shape = mesh_quality(mesh if order == 1 else to_linear(mesh))
    if shape.flat:
        raise Unmeshable(
            f"{shape.flat} elements of edges of {size:.3g} mm would be flat, one of them at "
            f"{place_of(np.array(shape.place))}"
        )
    if "base" in facets:
        return mesh
    base = np.concatenate([mesh.facet_set(name) for name in facets])
    sets = {**mesh.node_sets, "base": np.unique(base)}
    return Mesh(mesh.nodes, mesh.elements, sets, {**mesh.facet_sets, "base": base})


def directed_hausdorff(points: np.ndarray, reference: np.ndarray) -> float:
    """Return the directed Hausdorff distance in mm from ``points`` (k, 3) to ``reference``."""
    return float(cKDTree(reference, balanced_tree=False).query(points)[0].max())


def zipped(points: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return triangles (t, 3) between two closed loops (k,) and (l,) of ``points`` (n, 3)."""
    start = int(cKDTree(points[other], balanced_tree=False).query(points[one[0]])[1])
    other = np.roll(other, -start)
    if area_vector(points[one]) @ area_vector(points[other]) < 0.0:
        other = np.concatenate([other[:1], other[:0:-1]])
    loops = [np.append(loop, loop[0]) for loop in (one, other)]
    shares = []
    for loop in loops:
        steps = np.linalg.norm(np.diff(points[loop], axis=0), axis=1)
        shares.append(np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum())
    ends = [(share, k) for k, fractions in enumerate(shares) for share in fractions[1:].tolist()]
    at, rows = [0, 0], []
    for _, k in sorted(ends):
        rows.append((loops[0][at[0]], loops[1][at[1]], loops[k][at[k] + 1]))
        at[k] += 1
    return np.array(rows)


def _patch(
    points: np.ndarray, loops: Sequence[np.ndarray], size: float, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (t, 3) between loops, the outer one first, and the points (k, 3) they add.

    The points are as high above the outer loop's plane as those of the loops around them, and
    numbered from ``count``.
    """
    middle, normal = points[loops[0]].mean(axis=0), area_vector(points[loops[0]])
    frame = axes_across(normal / np.linalg.norm(normal))
    frame = np.vstack([frame, np.cross(*frame)])
    on_loops = np.concatenate(loops)
    at = (points[on_loops] - middle) @ frame.T
    ends = np.cumsum([0, *map(len, loops)])
    flat, rows = triangulate([at[a:b, :2] for a, b in pairwise(ends)], size)
    inner = flat[len(at) :]
    ways = np.linalg.norm(inner[:, None] - at[None, :, :2], axis=-1) ** -2.0
    height = (ways @ at[:, 2]) / ways.sum(axis=1)
    number = np.concatenate([on_loops, np.arange(count, count + len(inner))])
    return number[rows], middle + np.column_stack([inner, height]) @ frame
