r"""Surfaces of triangles: reading, checks, cuts by a plane, smoothing, tests of enclosure.

A surface is closed, or open with a rim or several. What a segmentation gives is rough: Taubin's
filter moves each point to the mean of its neighbours by a fraction :math:`\lambda` and back by
:math:`\mu`,

.. math:: x \leftarrow (1 + \mu L)(1 + \lambda L)\, x, \qquad \lambda > 0 > \mu, \quad
          |\mu| > \lambda,

with ``L x`` the neighbours' mean less ``x``, so that steps of voxels go and the volume stays
(Taubin 1995, A signal processing approach to fair surface design).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.facets import enclosed_volume, openings
from emulator.geometry.file_formats import read_cells
from emulator.geometry.mesh import SIDES, parts

_MERGE = 1e-6  # distance over the extent below which points are merged
_SNAP = 1e-4  # of the extent: points this near a plane lie in it, so that no slivers are cut off
# Taubin's filter: halves what repeats every five edges and keeps what repeats every twenty.
_LAMBDA, _MU = 0.5, -0.53
_TILT = 0.01


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with consistent normals.

    name : the name in messages. points : (n, 3) mm. triangles : (t, 3), normals pointing out.
    """

    name: str
    points: np.ndarray
    triangles: np.ndarray

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def rims(self) -> list[np.ndarray]:
        """Edges (e, 2) of each opening."""
        return openings(self.triangles)

    @property
    def normals(self) -> np.ndarray:
        """Unit normals (n, 3) at the points, pointing out: the mean of the triangles' by area."""
        a, b, c = np.moveaxis(self.points[self.triangles], 1, 0)
        sums = np.zeros_like(self.points)
        np.add.at(sums, self.triangles, np.cross(b - a, c - a)[:, None])
        return sums / np.linalg.norm(sums, axis=1, keepdims=True)

    @property
    def area(self) -> float:
        """Area of the triangles, mm2."""
        a, b, c = np.moveaxis(self.points[self.triangles], 1, 0)
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    @property
    def volume(self) -> float:
        """Enclosed with flat lids, mm3."""
        middle = self.points - self.points.mean(axis=0)
        volume: Callable[[np.ndarray], np.ndarray] = enclosed_volume(self.triangles)
        return float(volume(middle))


def read_surface(path: str | Path, name: str, scale: float = 1.0) -> Surface:
    """Return a surface from STL, PLY, OBJ or another file of triangles that meshio reads.

    :class:`InputError` as of :func:`surface`, or for a file that cannot be read or has other cells.

    name : the name of the surface in messages. scale : mm in one unit of the file.
    """
    content = read_cells(Path(path))
    kinds = sorted({block.type for block in content.cells if len(block.data)})
    if "triangle" not in kinds or set(kinds) - {"triangle", "line", "vertex"}:
        raise InputError(
            f"{name} {path}: it has {', '.join(kinds) or 'no cells'}; expected triangles only, "
            "as in STL or PLY"
        )
    points = scale * np.asarray(content.points, dtype=float)
    return surface(name, points, content.get_cells_type("triangle"))


def surface(name: str, points: np.ndarray, triangles: np.ndarray) -> Surface:
    """Return the surface of ``triangles`` (t, 3) between ``points`` (n, 3) mm, in any sense.

    Points at one place are merged, triangles without area dropped, and the others turned to face
    out. :class:`InputError` for several parts, three triangles at an edge, a Moebius strip, no
    volume, or NaN.
    """
    points = np.asarray(points, dtype=float)
    if not np.isfinite(points).all():
        raise InputError(f"{name}: a coordinate is not finite")
    if not len(triangles):
        raise InputError(f"{name}: it has no triangles")
    points, triangles = _merge_points(points, np.asarray(triangles, dtype=np.int64))
    if len(triangles) < 4:
        raise InputError(f"{name}: {len(triangles)} triangles with an area; expected a surface")
    triangles = _orient_consistently(name, points, triangles)
    checked = Surface(name, points, triangles)
    volume = checked.volume
    if abs(volume) < 1e-6 * checked.extent**3:
        raise InputError(f"{name}: it encloses no volume; expected a closed or cup-like surface")
    return checked if volume > 0.0 else Surface(name, points, triangles[:, ::-1].copy())


def _merge_points(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one point for each position, and the triangles whose corners differ."""
    tolerance = _MERGE * np.linalg.norm(np.ptp(points, axis=0))
    pairs = cKDTree(points, balanced_tree=False).query_pairs(tolerance, output_type="ndarray")
    label = parts(pairs, len(points))
    _, first = np.unique(label, return_index=True)
    a, b, c = label[triangles].T
    differ = (a != b) & (b != c) & (c != a)
    vertices, renumbered = np.unique(label[triangles[differ]], return_inverse=True)
    return points[first[vertices]], renumbered.reshape(-1, 3)


def _orient_consistently(name: str, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the triangles turned so that neighbours list a common edge in opposite senses."""
    edges = triangles[:, SIDES].reshape(-1, 2)
    owner = np.repeat(np.arange(len(triangles)), 3)
    ends = np.sort(edges, axis=1)
    order = np.lexsort(ends.T[::-1])
    same = (ends[order][1:] == ends[order][:-1]).all(axis=1)
    if (thrice := same[1:] & same[:-1]).any():
        position = place_of(points[edges[order[1:-1][thrice][0]]].mean(axis=0))
        raise InputError(
            f"{name}: more than two triangles meet at the edge at {position}; repair the surface"
        )
    one, other = order[:-1][same], order[1:][same]
    # Two copies of each triangle, one turned: neighbours that disagree join unlike copies.
    count = len(triangles)
    copy = np.where(edges[one, 0] != edges[other, 0], 0, count)
    first = np.concatenate([owner[one], owner[one] + count])
    second = np.concatenate([owner[other] + copy, owner[other] + count - copy])
    label = parts(np.column_stack([first, second]), 2 * count)
    sizes = np.sort(np.bincount(label))[::-2]
    if label.max() == 0:
        raise InputError(f"{name}: it has one side only; expected an inside and an outside")
    if len(sizes) > 1:
        raise InputError(
            f"{name}: it has {len(sizes)} separate parts, the largest of {sizes[0]} triangles and "
            f"the next of {sizes[1]}; expected one: keep the largest"
        )
    flipped = label[:count] != label[0]
    return np.where(flipped[:, None], triangles[:, ::-1], triangles)


def place_of(point: np.ndarray) -> str:
    """Return a point or a direction (3,) in words."""
    return "(" + ", ".join(f"{x:.4g}" for x in np.round(point, 6) + 0.0) + ")"


def cut(surface: Surface, point: np.ndarray, normal: np.ndarray) -> Surface:
    """Return the part below the plane through ``point`` (3,) mm with upward ``normal`` (3,).

    :class:`InputError` where the plane does not cut the surface, or leaves not just one opening.
    """
    height = (surface.points - point) @ normal
    height[np.abs(height) < _SNAP * surface.extent] = 0.0
    if not (height.min() < 0.0 <= height.max()):
        where = "above" if height.min() >= 0.0 else "below"
        along = surface.points @ normal
        raise InputError(
            f"{surface.name}: all of it is {where} the base plane through {place_of(point)}; "
            f"expected one that cuts it: --base-height between {along.min():.4g} and "
            f"{along.max():.4g} mm, or --axis the other way round"
        )
    flat = surface.points - np.outer((surface.points - point) @ normal, normal)
    points = np.where((height == 0.0)[:, None], flat, surface.points)
    below_it = clipped(Surface(surface.name, points, surface.triangles), height)
    one_rim(below_it, is_cut=True)
    return below_it


def clipped(surface: Surface, height: np.ndarray) -> Surface:
    """Return the part of a surface where ``height`` (n,), linear in each triangle, is below 0."""
    points = surface.points
    sign = np.sign(height).astype(int)[surface.triangles]
    below = (sign <= 0).all(axis=1) & (sign < 0).any(axis=1)
    rows = surface.triangles[below].tolist()
    numbers: dict[tuple[int, int], int] = {}
    new: list[np.ndarray] = []
    for row in surface.triangles[(sign < 0).any(axis=1) & (sign > 0).any(axis=1)].tolist():
        polygon: list[int] = []
        for a, b in ((row[0], row[1]), (row[1], row[2]), (row[2], row[0])):
            if height[a] <= 0.0:
                polygon.append(a)
            if height[a] * height[b] < 0.0:
                low, high = edge = min(a, b), max(a, b)
                if edge not in numbers:
                    numbers[edge] = len(points) + len(new)
                    share = height[low] / (height[low] - height[high])
                    new.append(points[low] + share * (points[high] - points[low]))
                polygon.append(numbers[edge])
        rows += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    vertices, numbered = np.unique(rows, return_inverse=True)
    places = np.concatenate([points, np.array(new).reshape(-1, 3)])[vertices]
    return Surface(surface.name, places, numbered.reshape(-1, 3))


def one_rim(surface: Surface, is_cut: bool = False) -> np.ndarray:
    """Return the edges (e, 2) of the only opening; :class:`InputError` locates the others.

    is_cut : whether it is what a base plane has left.
    """
    rims = sorted(surface.rims, key=len)
    if len(rims) == 1:
        return rims[0]
    if not rims:
        raise InputError(
            f"{surface.name}: it is closed; give the base plane, a height along the long axis or a "
            "point: --axis with --base-height or --base-point"
        )
    small = surface.points[np.unique(rims[0])].mean(axis=0)
    remedy = "give a base plane below them, --base-height or --base-point, and --axis"
    if is_cut:
        remedy = "lower the base plane, --base-height or --base-point, or turn --axis around"
    raise InputError(
        f"{surface.name}: it has {len(rims)} openings, the smallest of {len(rims[0])} edges at "
        f"{place_of(small)}; expected the base's alone: fill the others, or {remedy}"
    )


def smoothed(surface: Surface, times: int) -> Surface:
    """Return the surface after ``times`` passes of Taubin's filter, rims smoothed as curves.

    A flat rim stays in its plane.
    """
    count, rows = len(surface.points), surface.triangles
    edges = rows[:, SIDES].reshape(-1, 2)
    on_rim = np.zeros(count, dtype=bool)
    rims = surface.rims
    for rim in rims:
        on_rim[rim] = True
    directed_edges = edges[~on_rim[edges[:, 0]]], edges[~on_rim[edges[:, 1]]][:, ::-1], *rims
    pairs = np.concatenate([*directed_edges, *(rim[:, ::-1] for rim in rims)])
    graph = (coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count)) > 0).astype(float)
    mean = diags_array(1.0 / graph.sum(axis=1)) @ graph
    x = surface.points
    for factor in (_LAMBDA, _MU) * times:
        x = x + factor * (mean @ x - x)
    return Surface(surface.name, x, rows)


def inside(surface: Surface, points: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return whether each of ``points`` (k, 3) mm is enclosed; the lid must be above them.

    A ray from an enclosed point against ``axis`` (3,), away from the lid, crosses the surface an
    odd number of times.
    """
    # Rays are tilted against any grid, so that they practically never meet an edge.
    up = axis + _TILT * np.array([0.618, 0.733, 0.285])
    up /= np.linalg.norm(up)
    frame = np.stack([*axes_across(up), up], axis=1)
    corners, at = surface.points[surface.triangles] @ frame, points @ frame
    flat = corners[..., :2]
    middle = flat.mean(axis=1)
    reach = np.linalg.norm(flat - middle[:, None], axis=-1).max()
    neighbours = cKDTree(middle, balanced_tree=False).query_ball_point(at[:, :2], 1.000001 * reach)
    point = np.repeat(np.arange(len(at)), [len(candidates) for candidates in neighbours])
    row = np.concatenate([np.asarray(candidates, dtype=np.int64) for candidates in neighbours])
    # The areas between a ray and each side of the triangle, seen along the rays.
    rays, opposite = at[point, None, :2], ((1, 2), (2, 0), (0, 1))
    areas = np.stack(
        [signed_areas(np.hstack([flat[row][:, side], rays])) for side in opposite], axis=1
    )
    hits = (areas >= 0.0).all(axis=1) | (areas <= 0.0).all(axis=1)
    total = areas.sum(axis=1)
    hits &= total != 0.0
    weights = areas[hits] / total[hits, None]
    height = np.einsum("ka,ka->k", weights, corners[row[hits], :, 2])
    below = height < at[point[hits], 2]
    return np.bincount(point[hits][below], minlength=len(at)) % 2 == 1


def closed(surface: Surface, loops: Sequence[np.ndarray] | None = None) -> Surface:
    """Return the surface with a fan over each opening, or over those with rims ``loops`` (k,).

    Each fan is from the middle of its rim, a point that is added.
    """
    points, rows = [surface.points], [surface.triangles]
    for k, loop in enumerate(rim_loops(surface) if loops is None else loops):
        points.append(surface.points[loop].mean(axis=0, keepdims=True))
        middle = np.full(len(loop), len(surface.points) + k)
        rows.append(np.column_stack([np.roll(loop, -1), loop, middle]))
    return Surface(surface.name, np.concatenate(points), np.concatenate(rows))


def rim_loops(surface: Surface) -> list[np.ndarray]:
    """Return the points (k,) of each rim in order, the longest rim first."""
    loops = []
    for edges in surface.rims:
        successor = dict(edges.tolist())
        if len(successor) < len(edges):
            starts, counts = np.unique(edges[:, 0], return_counts=True)
            place = surface.points[starts[np.argmax(counts)]]
            raise InputError(
                f"{surface.name}: two of its openings touch at {place_of(place)}; fill one there"
            )
        loop = [int(edges[0, 0])]
        while (next_one := successor[loop[-1]]) != loop[0]:
            loop.append(next_one)
        loops.append(np.array(loop))
    return sorted(loops, key=lambda loop: -_perimeter(surface.points[loop]))


def _perimeter(polygon: np.ndarray) -> float:
    """Return the length in mm of a closed polygon (k, 3)."""
    return float(np.linalg.norm(polygon - np.roll(polygon, 1, axis=0), axis=1).sum())


def area_vector(polygon: np.ndarray) -> np.ndarray:
    """Return the area vector (3,) mm2 of a closed polygon (k, 3)."""
    middle = polygon - polygon.mean(axis=0)
    return 0.5 * np.cross(middle, np.roll(middle, -1, axis=0)).sum(axis=0)


def axis_to_rims(surface: Surface) -> np.ndarray:
    """Return the unit area vector (3,) of all rims together, towards them."""
    rims = [surface.points[loop] for loop in rim_loops(surface)]
    axis = np.sum([area_vector(rim) for rim in rims], axis=0)
    axis *= np.sign((np.concatenate(rims).mean(axis=0) - surface.points.mean(axis=0)) @ axis)
    return axis / np.linalg.norm(axis)


def sampled(surface: Surface, values: np.ndarray, finest: float) -> np.ndarray:
    """Return ``values`` (n, 3) of the points at places of each triangle, ``finest`` mm apart."""
    corners = surface.points[surface.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max()
    count = max(int(np.ceil(longest / finest)), 1)
    shares = [(i, j, count - i - j) for i in range(count + 1) for j in range(count + 1 - i)]
    at_places = np.array(shares) / count
    return np.einsum("qa,tai->tqi", at_places, values[surface.triangles]).reshape(-1, 3)


def axes_across(normal: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) across the unit ``normal`` (3,) and each other."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def signed_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (t,) of triangles (t, 3, 2) in the plane, positive anticlockwise."""
    (ux, uy), (vx, vy) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return 0.5 * (ux * vy - uy * vx)
