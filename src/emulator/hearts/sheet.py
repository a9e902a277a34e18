"""A sheet of tissue, such as skin, from outlines in its plane.

Triangles of the plane, fine about the pads and coarser away from them, are extruded to tetrahedra.
The sides of pads are sides of triangles; those of regions are not, because no scar ends at a line:
an element lies in a region if its middle does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body, extrude, stacked
from emulator.geometry.mesh import Mesh
from emulator.hearts.remeshing import triangulate, within

_GROWTH = 0.25  # of an edge's length, per length away from the pads
_ON_A_SIDE = 1e-9  # of the sheet's extent, round-off of a place on a polygon
_PLANES = ("bottom", "top")


def mesh_sheet(
    outline: np.ndarray,
    thickness: float,
    *,
    size: float,
    pads: Mapping[str, np.ndarray],
    coarsest: float | None = None,
    layers: int = 1,
    order: int = 2,
) -> Mesh:
    """Return tetrahedra of a sheet from z = 0 to z = ``thickness``. It takes Gmsh.

    Parameters
    ----------
    outline : the corners of the sheet in order, (k, 2) mm.
    thickness : the sheet's thickness, mm.
    size : the length of edges at the pads and between them, mm.
    pads : the corners (k, 2) mm of what is glued to the top, by name.
    coarsest : the length of edges far from the pads, mm; by default eight times ``size``.
    layers : the number of elements across the thickness.
    order : the order of the elements, 1 or 2.

    Returns
    -------
    Mesh with node sets edge, bottom, top and one a pad, of the nodes at the top; and facet sets
    bottom and top.

    Raises
    ------
    InputError
        Lengths that are not above 0, a polygon that is none, polygons that cross or lie outside, no
        pad, a pad called as another set.
    """
    if not (thickness > 0.0 and size > 0.0 and layers >= 1):
        raise InputError(
            f"sheet: thickness {thickness} mm, edges of {size} mm, {layers} layers; expected "
            "numbers above 0"
        )
    if not pads or {*pads} & {*_PLANES, "edge"}:
        raise InputError("sheet: give one pad or more, not called edge, bottom or top")
    around, *glued = (_polygon(p, n) for n, p in {"outline": outline, **pads}.items())
    edge = _growing(glued, size, 8.0 * size if coarsest is None else max(coarsest, size))
    sides = [
        np.vstack([_divided(a, b, edge) for a, b in _sides(loop)]) for loop in (around, *glued)
    ]
    plane, triangles = triangulate(sides, edge, filled=True)
    vertices, slack = len(plane), _ON_A_SIDE * float(np.ptp(plane, axis=0).max())
    columns = stacked(vertices, layers)
    heights = np.repeat(np.linspace(0.0, thickness, layers + 1), vertices)
    nodes = np.column_stack([np.tile(plane, (layers + 1, 1)), heights])
    planes = dict(zip(_PLANES, (columns[:, 0], columns[:, -1]), strict=True))
    sets = {"edge": columns[_close(plane, around, slack)].ravel(), **planes}
    for name, pad in zip(pads, glued, strict=True):
        sets[name] = columns[within(plane, pad) | _close(plane, pad, slack), -1]
    return body(nodes, extrude(columns, triangles), planes, sets, None, order)


def _growing(pads: list[np.ndarray], size: float, most: float) -> Callable[[float, float], float]:
    """Return the length of edges in mm at a point (x, y): ``size`` in the box of all pads.

    Beyond it grows with the distance, up to ``most``.
    """
    low = np.min([pad.min(axis=0) for pad in pads], axis=0)
    high = np.max([pad.max(axis=0) for pad in pads], axis=0)

    def edge(x: float, y: float) -> float:
        beyond = np.maximum(0.0, np.maximum(low - (x, y), np.array([x, y]) - high))
        return min(size + _GROWTH * float(np.hypot(*beyond)), most)

    return edge


def regions_within(mesh: Mesh, polygons: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return the region (m,) of each element of a sheet: 0 outside of all polygons.

    polygons : the corners (k, 2) mm of each region, by its number; of those that overlap the last
        one counts.

    :class:`InputError` for a region in which no element lies.
    """
    middles = mesh.nodes[mesh.corners].mean(axis=1)[:, :2]
    regions = np.zeros(len(middles), dtype=int)
    for number, polygon in polygons.items():
        inside = within(middles, _polygon(polygon, f"region {number}"))
        if not inside.any():
            raise InputError(f"sheet: no element lies in region {number}; is it in mm?")
        regions[inside] = number
    return regions


def _polygon(corners: np.ndarray, name: str) -> np.ndarray:
    """Return corners (k, 2), anticlockwise and without the first one repeated."""
    points = np.asarray(corners, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise InputError(f"sheet: {name} has shape {points.shape}; expected corners (k, 2) in mm")
    if len(points) and (points[0] == points[-1]).all():
        points = points[:-1]
    ends = np.roll(points, -1, axis=0)
    area = 0.5 * float(np.sum(points[:, 0] * ends[:, 1] - ends[:, 0] * points[:, 1]))
    if len(points) < 3 or area == 0.0:
        raise InputError(f"sheet: {name} has {len(points)} corners and no area")
    return points if area > 0.0 else points[::-1]


def _sides(loop: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield both ends of each side."""
    return zip(loop, np.roll(loop, -1, axis=0), strict=True)


def _divided(a: np.ndarray, b: np.ndarray, edge: Callable[[float, float], float]) -> np.ndarray:
    """Return points (k, 2) from ``a`` on, ``b`` left out, as far apart as edges are there."""
    length = float(np.linalg.norm(b - a))
    steps = np.linspace(0.0, 1.0, 200)
    density = np.array([length / edge(*(a + s * (b - a))) for s in steps])
    passed = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(steps))])
    count = max(1, round(passed[-1]))
    at = np.interp(np.arange(count) * passed[-1] / count, passed, steps)
    return a + at[:, None] * (b - a)


def _close(points: np.ndarray, loop: np.ndarray, slack: float) -> np.ndarray:
    """Return whether each of points (d, 2) lies on a side of the polygon, (d,) bool."""
    on = np.zeros(len(points), dtype=bool)
    for a, b in _sides(loop):
        along = np.clip((points - a) @ (b - a) / np.sum((b - a) ** 2), 0.0, 1.0)
        on |= np.linalg.norm(points - a - along[:, None] * (b - a), axis=1) <= slack
    return on
