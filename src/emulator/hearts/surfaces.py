r"""Surfaces of triangles: reading, checks, cuts by a plane, smoothing, tests of enclosure.

A surface is closed, or open with a rim or several. Files, normals, rays and nearest points are by
trimesh (extra ``surfaces``). What a segmentation gives is rough: Taubin's filter moves each point
to the mean of its neighbours by a fraction :math:`\lambda` and back by :math:`\mu`,

.. math:: x \leftarrow (1 + \mu L)(1 + \lambda L)\, x, \qquad \lambda > 0 > \mu, \quad
          |\mu| > \lambda,

with ``L x`` the neighbours' mean less ``x``, so that steps of voxels go and the volume stays
(Taubin 1995, A signal processing approach to fair surface design).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import meshio
import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.facets import enclosed_volume, openings
from emulator.geometry.file_formats import read_cells
from emulator.geometry.mesh import parts

try:
    import rtree  # noqa: F401, trimesh looks for nearest triangles by it
    from trimesh import Trimesh, load_mesh
    from trimesh.grouping import group_rows
    from trimesh.proximity import closest_point
    from trimesh.smoothing import filter_taubin
    from trimesh.triangles import points_to_barycentric
except ModuleNotFoundError as error:
    raise InputError(
        "surfaces need trimesh: pip install 'soft-tissue-calibrate[surfaces]'"
    ) from error

_MERGE = 1e-6  # distance over the extent below which points are merged
_SNAP = 1e-4  # of the extent: points this near a plane lie in it, so that no slivers are cut off
# Taubin's filter: halves what repeats every five edges and keeps what repeats every twenty.
_LAMBDA, _MU = 0.5, 0.53
_RAY = np.array([0.00618, 0.00733, 1.0])  # tilted against any grid, so that it meets no edge
_CHUNK = 1000  # points whose nearest triangles are looked for together, which takes memory
_FORMATS = (".stl", ".ply", ".obj", ".off")  # which trimesh reads; the others are meshio's


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with consistent normals.

    name : the name in messages. points : (n, 3) mm. triangles : (t, 3), normals pointing out.
    """

    name: str
    points: np.ndarray
    triangles: np.ndarray

    @cached_property
    def mesh(self) -> Trimesh:
        """The triangles with their normals, areas and rays."""
        return Trimesh(self.points, self.triangles, process=False)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the nearest point (k, 3) mm, the distance (k,) mm and the unit normal there."""
        places, ways, rows = closest_point(self.mesh, points)
        weights = points_to_barycentric(self.mesh.triangles[rows], places)
        normals = self.mesh.vertex_normals[self.triangles[rows]]
        return places, ways, np.einsum("ka,kai->ki", weights, normals)

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def rims(self) -> list[np.ndarray]:
        """Edges (e, 2) of each opening."""
        return openings(self.triangles)

    @cached_property
    def volume(self) -> float:
        """Enclosed with flat lids, mm3."""
        middle = self.points - self.points.mean(axis=0)
        volume: Callable[[np.ndarray], np.ndarray] = enclosed_volume(self.triangles)
        return float(volume(middle))


def read_surface(path: str | Path, name: str, scale: float = 1.0) -> Surface:
    """Return a surface from STL, PLY, OBJ, OFF or another file of triangles that meshio reads.

    :class:`InputError` as of :func:`surface`, or for a file that cannot be read or has other cells.

    name : the name of the surface in messages. scale : mm in one unit of the file.
    """
    by_trimesh = Path(path).suffix.lower() in _FORMATS
    content = read_cells(Path(path), _read_triangles if by_trimesh else None)
    kinds = sorted({block.type for block in content.cells if len(block.data)})
    if "triangle" not in kinds or set(kinds) - {"triangle", "line", "vertex"}:
        raise InputError(
            f"{name} {path}: it has {', '.join(kinds) or 'no cells'}; expected triangles only, "
            "as in STL or PLY"
        )
    points = scale * np.asarray(content.points, dtype=float)
    return surface(name, points, content.get_cells_type("triangle"))


def _read_triangles(path: Path) -> meshio.Mesh:
    """Return the triangles of a file, its polygons cut into triangles."""
    mesh = load_mesh(path, process=False)
    return meshio.Mesh(mesh.vertices, [("triangle", mesh.faces)])


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
    mesh, count = Trimesh(points, triangles, process=False), len(triangles)
    edges, owner = mesh.edges, mesh.edges_face
    if (thrice := np.bincount(mesh.edges_unique_inverse) > 2).any():
        position = place_of(points[mesh.edges_unique[thrice][0]].mean(axis=0))
        raise InputError(
            f"{name}: more than two triangles meet at the edge at {position}; repair the surface"
        )
    one, other = group_rows(mesh.edges_sorted, require_count=2).T
    # Two copies of each triangle, one turned: neighbours that disagree join unlike copies.
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
            "point: --axis with --base-height or --base-point; one closed surface of the muscle, "
            "with both walls, is given as endocardium and as epicardium"
        )
    small = surface.points[np.unique(rims[0])].mean(axis=0)
    remedy = "give a base plane below them, --base-height or --base-point, and --axis"
    if is_cut:
        remedy = (
            "lower the base plane, --base-height or --base-point, or turn --axis around; one "
            "surface with both walls is given as endocardium and as epicardium"
        )
    raise InputError(
        f"{surface.name}: it has {len(rims)} openings, the smallest of {len(rims[0])} edges at "
        f"{place_of(small)}; expected the base's alone: fill the others, or {remedy}"
    )


def smoothed(surface: Surface, times: int) -> Surface:
    """Return the surface after ``times`` passes of Taubin's filter, rims smoothed as curves.

    A flat rim stays in its plane.
    """
    count, rims, edges = len(surface.points), surface.rims, surface.mesh.edges
    on_rim = np.zeros(count, dtype=bool)
    for rim in rims:
        on_rim[rim] = True
    directed_edges = edges[~on_rim[edges[:, 0]]], edges[~on_rim[edges[:, 1]]][:, ::-1], *rims
    mean = neighbour_means(
        np.concatenate([*directed_edges, *(rim[:, ::-1] for rim in rims)]), count
    )
    smooth = filter_taubin(surface.mesh.copy(), _LAMBDA, _MU, 2 * times, mean)
    return Surface(surface.name, np.array(smooth.vertices), surface.triangles)


def neighbour_means(pairs: np.ndarray, count: int) -> coo_array:
    """Return the matrix (n, n) that takes the mean over the second points of ``pairs`` (k, 2)."""
    graph = (coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count)) > 0).astype(float)
    return diags_array(1.0 / graph.sum(axis=1)) @ graph


def inside(surface: Surface, points: np.ndarray) -> np.ndarray:
    """Return whether each of ``points`` (k, 3) mm is within a surface and flat lids on its rims.

    A ray from an enclosed point crosses the closed surface an odd number of times.
    """
    rays = np.broadcast_to(_RAY, points.shape)
    _, crossing = closed(surface).mesh.ray.intersects_id(points, rays)
    return np.bincount(crossing, minlength=len(points)) % 2 == 1


def nearest(surfaces: Sequence[Surface], points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the nearest point (k, 3) of any surface, the way to it (k,) mm, and its normal."""
    parts_of = [
        [np.concatenate(values) for values in zip(*map(surface.nearest, chunks), strict=True)]
        for chunks in [np.array_split(points, len(points) // _CHUNK + 1)]
        for surface in surfaces
    ]
    places, ways, normals = (np.stack(values) for values in zip(*parts_of, strict=True))
    rows = np.argmin(ways, axis=0), np.arange(len(points))
    return places[rows], ways[rows], normals[rows]


def distances(points: np.ndarray, around: Sequence[Surface]) -> np.ndarray:
    """Return each point's distance (n,) mm to the nearest corner, middle or side of surfaces."""
    places = []
    for surface in around:
        corners = surface.points[surface.triangles]
        middles = 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)
        places += [surface.points, corners.mean(axis=1), middles]
    return cKDTree(np.vstack(places), balanced_tree=False).query(points)[0]


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
