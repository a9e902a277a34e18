r"""Surfaces of triangles: reading, checks, cuts by a plane, smoothing, tests of enclosure.

A surface is closed, or open with one rim. What a segmentation gives is rough: Taubin's filter moves
each point to the mean of its neighbours by a fraction :math:`\lambda` and back by :math:`\mu`,

.. math:: x \leftarrow (1 + \mu L)(1 + \lambda L)\, x, \qquad \lambda > 0 > \mu, \quad
          |\mu| > \lambda,

with ``L x`` the neighbours' mean less ``x``, so that steps of voxels go and the volume stays
(Taubin 1995, A signal processing approach to fair surface design).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.facets import enclosed_volume, openings
from emulator.geometry.io import read_cells

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Millimetres in a unit of length."""
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
    def volume(self) -> float:
        """Enclosed with flat lids, mm3."""
        middle = self.points - self.points.mean(axis=0)
        volume: Callable[[np.ndarray], np.ndarray] = enclosed_volume(self.triangles)
        return float(volume(middle))


def read_surface(path: str | Path, name: str, scale: float = 1.0) -> Surface:
    """Return a surface from STL, PLY, OBJ or another file of triangles that meshio reads.

    Parameters
    ----------
    name : the name of the surface in messages.
    scale : mm in one unit of the file.

    Raises
    ------
    InputError
        As :func:`surface`; or a file that cannot be read or has other cells than triangles.
    """
    content = read_cells(Path(path))
    kinds = sorted({block.type for block in content.cells if len(block.data)})
    if "triangle" not in kinds or set(kinds) - {"triangle", "line", "vertex"}:
        raise InputError(
            f"{name} {path}: it has {', '.join(kinds) or 'no cells'}; expected triangles only, "
            "as in STL or PLY"
        )
    rows = np.concatenate([block.data for block in content.cells if block.type == "triangle"])
    return surface(name, scale * np.asarray(content.points, dtype=float), rows)


def surface(name: str, points: np.ndarray, triangles: np.ndarray) -> Surface:
    """Return the surface of ``triangles`` (t, 3) between ``points`` (n, 3) mm, in any sense.

    Points at one place are merged, triangles without area dropped, and the others turned to face
    out.

    Raises
    ------
    InputError
        Several parts, three triangles at an edge, a Moebius strip, no volume, or NaN.
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
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    triangles = connected_components(graph, directed=False)[1][triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    label = connected_components(graph, directed=False)[1]
    _, first = np.unique(label, return_index=True)
    vertices, renumbered = np.unique(triangles, return_inverse=True)
    return points[first[vertices]], renumbered.reshape(-1, 3)


def _orient_consistently(name: str, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the triangles turned so that neighbours list a common edge in opposite senses."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(np.arange(len(triangles)), 3)
    low, high = edges.min(axis=1), edges.max(axis=1)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    if (same[1:] & same[:-1]).any():
        k = order[1:-1][same[1:] & same[:-1]][0]
        position = place_of(points[edges[k]].mean(axis=0))
        raise InputError(
            f"{name}: more than two triangles meet at the edge at {position}; repair the surface"
        )
    one, other = order[:-1][same], order[1:][same]
    agree = edges[one, 0] != edges[other, 0]
    # Two copies of each triangle, one turned: neighbours that disagree join unlike copies.
    count = len(triangles)
    component = np.where(agree, 0, count)
    first = np.concatenate([owner[one], owner[one] + count])
    second = np.concatenate([owner[other] + component, owner[other] + count - component])
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(2 * count,) * 2)
    parts, label = connected_components(graph, directed=False)
    if parts == 1:
        raise InputError(f"{name}: it has one side only; expected an inside and an outside")
    if parts > 2:
        sizes = np.sort(np.bincount(label))[::-2]
        raise InputError(
            f"{name}: it has {parts // 2} separate parts, the largest of {sizes[0]} triangles and "
            f"the next of {sizes[1]}; expected one: keep the largest"
        )
    flipped = label[:count] != label[0]
    return np.where(flipped[:, None], triangles[:, ::-1], triangles)


def place_of(point: np.ndarray) -> str:
    """Return a point or a direction (3,) in words."""
    return "(" + ", ".join(f"{x:.4g}" for x in np.round(point, 6) + 0.0) + ")"


def cut(surface: Surface, point: np.ndarray, normal: np.ndarray) -> Surface:
    """Return the part below the plane through ``point`` (3,) mm with upward ``normal`` (3,).

    Raises
    ------
    InputError
        A plane that does not cut the surface, or leaves another number of openings than one.
    """
    height = (surface.points - point) @ normal
    height[np.abs(height) < _SNAP * surface.extent] = 0.0
    if not (height.min() < 0.0 <= height.max()):
        where = "above" if height.min() >= 0.0 else "below"
        raise InputError(
            f"{surface.name}: all of it is {where} the base plane through {place_of(point)}, its "
            f"heights {height.min():.4g} to {height.max():.4g} mm; expected a plane that cuts it"
        )
    points = np.where(
        (height == 0.0)[:, None],
        surface.points - np.outer((surface.points - point) @ normal, normal),
        surface.points,
    )
    sign = np.sign(height).astype(int)[surface.triangles]
    below = (sign <= 0).all(axis=1) & (sign < 0).any(axis=1)
    pieces = [surface.triangles[below]]
    new_points: list[np.ndarray] = []
    numbers: dict[tuple[int, int], int] = {}

    def between(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in numbers:
            low, high = key
            share = height[low] / (height[low] - height[high])
            numbers[key] = len(points) + len(new_points)
            new_points.append(points[low] + share * (points[high] - points[low]))
        return numbers[key]

    new: list[tuple[int, int, int]] = []
    for row in surface.triangles[(sign < 0).any(axis=1) & (sign > 0).any(axis=1)].tolist():
        polygon: list[int] = []
        for a, b in zip(row, [*row[1:], row[0]], strict=True):
            if height[a] <= 0.0:
                polygon.append(a)
            if height[a] * height[b] < 0.0:
                polygon.append(between(a, b))
        new += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    pieces.append(np.array(new, dtype=np.int64).reshape(-1, 3))
    rows = np.concatenate(pieces)
    vertices, numbered = np.unique(rows, return_inverse=True)
    places = np.concatenate([points, np.array(new_points).reshape(-1, 3)])[vertices]
    below_it = Surface(surface.name, places, numbered.reshape(-1, 3))
    one_rim(below_it)
    return below_it


def one_rim(surface: Surface) -> np.ndarray:
    """Return the edges (e, 2) of the only opening; :class:`InputError` locates the others."""
    rims = sorted(surface.rims, key=len)
    if len(rims) == 1:
        return rims[0]
    if not rims:
        raise InputError(
            f"{surface.name}: it is closed; give the base plane, a height along the long axis or a "
            "point and a normal"
        )
    small = surface.points[np.unique(rims[0])].mean(axis=0)
    raise InputError(
        f"{surface.name}: it has {len(rims)} openings, the smallest of {len(rims[0])} edges at "
        f"{place_of(small)}; expected the base's alone: fill the others"
    )


def smoothed(surface: Surface, times: int) -> Surface:
    """Return the surface after ``times`` passes of Taubin's filter, rims smoothed as curves.

    A flat rim stays in its plane.
    """
    count, rows = len(surface.points), surface.triangles
    edges = np.concatenate([rows[:, [0, 1]], rows[:, [1, 2]], rows[:, [2, 0]]])
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
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(up, across), up], axis=1)
    corners, at = surface.points[surface.triangles] @ frame, points @ frame
    flat = corners[..., :2]
    middle = flat.mean(axis=1)
    reach = np.linalg.norm(flat - middle[:, None], axis=-1).max()
    neighbours = cKDTree(middle, balanced_tree=False).query_ball_point(at[:, :2], 1.000001 * reach)
    point = np.repeat(np.arange(len(at)), [len(candidates) for candidates in neighbours])
    row = np.concatenate([np.asarray(candidates, dtype=np.int64) for candidates in neighbours])
    a, b, c = (corners[row, k] for k in range(3))
    p = at[point]

    def area(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
        return (v[:, 0] - u[:, 0]) * (w[:, 1] - u[:, 1]) - (v[:, 1] - u[:, 1]) * (w[:, 0] - u[:, 0])

    parts = np.stack([area(b, c, p), area(c, a, p), area(a, b, p)], axis=1)
    hits = (parts >= 0.0).all(axis=1) | (parts <= 0.0).all(axis=1)
    total = parts.sum(axis=1)
    hits &= total != 0.0
    weights = parts[hits] / total[hits, None]
    height = np.einsum("ka,ka->k", weights, corners[row[hits], :, 2])
    below = height < p[hits, 2]
    return np.bincount(point[hits][below], minlength=len(at)) % 2 == 1
