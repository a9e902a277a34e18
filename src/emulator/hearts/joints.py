r"""Joints between surfaces: where a wall ends, at a base plane or at the valves.

Each opening of an endocardium is a valve, or the base of a ventricle, and belongs to the nearest
opening of the epicardium. There the wall ends in a ring of triangles between both rims, or, where
rims lie in one plane or an opening of the epicardium is around several, in one patch between all.

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
from itertools import combinations, pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.discretisation import mesh_quality
from emulator.geometry.fibres import BOTH
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_linear
from emulator.hearts.remeshing import DiscMap, Unmeshable, triangulate
from emulator.hearts.surfaces import (
    Surface,
    area_vector,
    clipped,
    distances,
    inside,
    nearest,
    place_of,
    rim_loops,
)
from emulator.hearts.wall import fill

try:
    from trimesh import transform_points
    from trimesh.geometry import plane_transform
except ModuleNotFoundError as error:
    raise InputError(
        "surfaces need trimesh: pip install 'soft-tissue-calibrate[surfaces]'"
    ) from error

LEFT, RIGHT, EPICARDIUM = BOTH
VALVES: Mapping[str, tuple[str, ...]] = {
    LEFT: ("mitral", "aortic"),
    RIGHT: ("tricuspid", "pulmonary"),
}
"""The valves of each ventricle, the longer rim first."""
LEAST = 2.0
"""Default least thickness of the wall of both ventricles, mm: the epicardium is moved to it."""
_RING = 4.0  # mm, width of the ring at a valve where surfaces meet
_SLOPE = 0.5  # of the distance to a rim, likewise: the wall ends in no sharper edge than 30 degrees
_BETWEEN = 0.4  # of the way between two valves' rims: nothing is cut off further away
_NARROW = 1.5  # of the edges: what joins rims further apart gets nodes of its own
_FLAT = 1e-3  # of the edges: rims in one plane are joined in it
_ASTRAY = 1.0  # of a rim's radius: further away, an opening of the epicardium is another one

Joint = list[tuple[int, int]]
"""Openings that the wall ends between: surface and rim of each, the epicardium's first."""


def joints_of(surfaces: Sequence[Surface]) -> dict[str, Joint]:
    """Return the openings of inner and outer surface that belong together, by valve or base."""
    loops = [rim_loops(surface) for surface in surfaces]
    for surface, rims in zip(surfaces, loops, strict=True):
        if not rims:
            raise InputError(
                f"{surface.name}: it is closed; expected it open at valves or base: give the base "
                "plane, --axis with --base-height or --base-point"
            )
    outer = [surfaces[-1].points[loop] for loop in loops[-1]]
    trees = [cKDTree(rim, balanced_tree=False) for rim in outer]
    joints: dict[int, Joint] = {}
    names: dict[int, str] = {}
    for k, (surface, rims) in enumerate(zip(surfaces[:-1], loops[:-1], strict=True)):
        valves = VALVES.get(surface.name, ("base",))
        if len(rims) > len(valves):
            raise InputError(
                f"{surface.name}: it has {len(rims)} openings, the smallest of {len(rims[-1])} "
                f"edges at {place_of(surface.points[rims[-1]].mean(axis=0))}; expected two valves "
                "at most: fill the others"
            )
        for number, loop in enumerate(rims):
            rim = surface.points[loop]
            ways = [tree.query(rim)[0].mean() for tree in trees]
            closest = int(np.argmin(ways))
            radius = np.sqrt(np.linalg.norm(area_vector(rim)) / np.pi)
            if len(surfaces) > 2 and ways[closest] > _ASTRAY * radius:
                raise InputError(
                    f"{surface.name}: no opening of the epicardium is at its opening around "
                    f"{place_of(rim.mean(axis=0))}; the nearest is {ways[closest]:.3g} mm away"
                )
            joints.setdefault(closest, [(len(loops) - 1, closest)]).append((k, number))
            names[closest] = valves[number] if len(rims) > 1 else f"{surface.name}_base"
    for number, rim in enumerate(outer):
        if number not in joints:
            raise InputError(
                f"{surfaces[-1].name}: neither endocardium has an opening at that around "
                f"{place_of(rim.mean(axis=0))}, of {len(rim)} edges; fill it"
            )
    if len(joints) == 1:
        return {"base": joints[0]}
    return {
        names[n] if len(openings) == 2 else f"{surfaces[openings[1][0]].name}_base": openings
        for n, openings in joints.items()
    }


def thickened(outer: Surface, inner: Sequence[Surface], least: float) -> Surface:
    """Return the epicardium with its points at least ``least`` mm from all endocardia."""
    rims = np.vstack([surface.points[loop] for surface in inner for loop in rim_loops(surface)])
    to_rim = cKDTree(rims, balanced_tree=False).query(outer.points)[0]
    h = np.minimum(least, _SLOPE * to_rim)
    edge = max(surface.mesh.edges_unique_length.max() for surface in inner)
    rows = np.flatnonzero(distances(outer.points, inner) < h + edge)
    x, d, normals = nearest(inner, outer.points[rows])
    close = d < h[rows]
    rows, x, d = rows[close], x[close], d[close, None]
    points, h = outer.points.copy(), h[rows, None]
    away = points[rows] - x + (h - d) * normals[close]
    points[rows] = x + h * away / np.linalg.norm(away, axis=1, keepdims=True)
    return Surface(outer.name, points, outer.triangles)


def without_edge(outer: Surface, inner: Sequence[Surface], scale: float) -> Surface:
    """Return the epicardium without a ring at each of its rims that meets an endocardium's rim.

    The ring is narrower where rims are so near to each other that little would be left between.

    scale : the heart's size over that of a large one.
    """
    rims = np.vstack([surface.points[loop] for surface in inner for loop in rim_loops(surface)])
    loops = rim_loops(outer)
    trees = [cKDTree(outer.points[loop], balanced_tree=False) for loop in loops]
    pairs = combinations(range(len(loops)), 2)
    between = [trees[k].query(outer.points[loops[other]])[0].min() for k, other in pairs]
    to_rim = cKDTree(rims, balanced_tree=False).query(outer.points)[0]
    meeting = [loop for loop in loops if to_rim[loop].mean() < scale * LEAST]
    if not meeting:
        return outer
    edges, lengths = outer.mesh.edges_unique, outer.mesh.edges_unique_length
    graph = coo_array((lengths, edges.T), shape=(len(outer.points),) * 2).tocsr()
    ways = dijkstra(graph, directed=False, indices=np.concatenate(meeting), min_only=True)
    return clipped(outer, min(scale * _RING, _BETWEEN * min(between, default=np.inf)) - ways)


def mesh_between(
    maps: Sequence[DiscMap], joints: Mapping[str, Joint], axis: np.ndarray, order: int, size: float
) -> Mesh:
    """Return tetrahedra between surfaces, the epicardium last; :class:`Unmeshable` if too thin."""
    new = [disc_map.remeshed(size) for disc_map in maps]
    for k, triangulation in enumerate(new):
        points = triangulation.surface.points
        rims = cKDTree(points[np.concatenate(triangulation.loops)], balanced_tree=False)
        points = points[rims.query(points)[0] > size]  # a lid may be below a rim's points
        bad = np.zeros(len(points), dtype=bool)
        for other in (*new[:k], *new[k + 1 :]):
            bad |= inside(other.surface, points) != (other is new[-1])
        if bad.any():
            raise Unmeshable(
                f"the wall is too thin for edges of {size:.3g} mm at {place_of(points[bad][0])}"
            )
    points = np.vstack([triangulation.surface.points for triangulation in new])
    first = np.cumsum([0, *(len(triangulation.surface.points) for triangulation in new)])
    facets, more = dict[str, np.ndarray](), np.zeros((0, 3))
    for name, openings in joints.items():
        loops = [first[k] + new[k].loops[number] for k, number in openings]
        facets[name], added = _joined(points, loops, size, len(points) + len(more))
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


def _joined(
    points: np.ndarray, loops: Sequence[np.ndarray], size: float, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (t, 3) between loops, the outer one first, and the points (k, 3) they add.

    These are as high above the outer loop's plane as those of the loops around them, and numbered
    from ``count``.
    """
    on_loops = np.concatenate(loops)
    to_plane = plane_transform(points[loops[0]].mean(axis=0), area_vector(points[loops[0]]))
    at = transform_points(points[on_loops], to_plane)
    is_flat = np.abs(at[:, 2]).max() < _FLAT * size
    gap = directed_hausdorff(points[loops[0]], points[loops[1]])
    if len(loops) == 2 and not is_flat and gap < _NARROW * size:
        return zipped(points, *loops), np.zeros((0, 3))
    ends = np.cumsum([0, *map(len, loops)])
    flat, rows = triangulate([at[a:b, :2] for a, b in pairwise(ends)], size)
    inner = flat[len(at) :]
    ways = np.linalg.norm(inner[:, None] - at[None, :, :2], axis=-1) ** -2.0
    height = (ways @ at[:, 2]) / ways.sum(axis=1)
    number = np.concatenate([on_loops, np.arange(count, count + len(inner))])
    added = np.column_stack([inner, height])
    return number[rows], (added - to_plane[:3, 3]) @ to_plane[:3, :3]
