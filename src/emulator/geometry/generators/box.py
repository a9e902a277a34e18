"""Structured meshes of a box and of a plane-strain slab, a quadrilateral that is one cell thick."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from skfem import MeshTet

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body, extrude, stacked
from emulator.geometry.mesh import Mesh

_X, _Y, _Z = ("left", "right"), ("front", "back"), ("bottom", "top")  # faces of a box


def toward_ends(count: int, grading: float, ends: tuple[str, ...]) -> np.ndarray:
    """Return the ends (count + 1,) of cells on [0, 1], closer at some of its ends.

    Cell k of n ends at :math:`(k/n)^g` where ``left`` is to be fine; likewise from the ``right``,
    and from both ends to the middle.

    Parameters
    ----------
    grading : the exponent g; 1 is even, and more is finer at the ends.
    ends : the fine ends, ``left``, ``right`` or both.

    Raises
    ------
    InputError
        ``grading`` is less than 1 or not finite.
    """
    if not 1.0 <= grading < np.inf:
        raise InputError(f"grading of cells is {grading}; expected 1 (even) or more")
    even = np.linspace(0.0, 1.0, count + 1)
    if set(ends) == {"left", "right"}:
        half = 0.5 * (2.0 * np.minimum(even, 1.0 - even)) ** grading
        return np.where(even <= 0.5, half, 1.0 - half)
    return even**grading if "left" in ends else 1.0 - (1.0 - even) ** grading


def box(
    lengths: tuple[float, float, float],
    cells: tuple[int, int, int],
    order: int = 1,
    along: np.ndarray | None = None,
) -> Mesh:
    """Return the box ``[0, lengths]`` of six tetrahedra a cell, nodes numbered x first, then y, z.

    Parameters
    ----------
    lengths, cells : mm and number of cells along x, y, z.
    order : the order of the elements, 1 or 2.
    along : (cells[0] + 1,) ends of the cells along x as fractions of its length, see
        :func:`toward_ends`; even by default.

    Returns
    -------
    Mesh with node sets and facet sets left/right (x), front/back (y), bottom/top (z).
    """
    if min(lengths) <= 0.0 or min(cells) < 1:
        raise InputError(f"box: lengths {lengths} and cells {cells} must be positive")
    axes = [
        np.linspace(0.0, length, count + 1) for length, count in zip(lengths, cells, strict=True)
    ]
    if along is not None:
        axes[0] = lengths[0] * along
    grid = MeshTet.init_tensor(*axes)
    nodes, elements = grid.p.T, grid.t.T
    listed = np.lexsort(nodes.T)  # the last key, z, is the slowest
    rank = np.argsort(listed)
    nodes, elements = nodes[listed], rank[elements]
    sets = {
        name: np.flatnonzero(x == end)
        for names, x, ends in zip((_X, _Y, _Z), nodes.T, axes, strict=True)
        for name, end in zip(names, ends[[0, -1]], strict=True)
    }
    return body(nodes, elements, sets, sets, None, order)


Corner = tuple[float, float]
COOKS_MEMBRANE: tuple[Corner, Corner, Corner, Corner] = ((0, 0), (48, 44), (48, 60), (0, 44))
"""Corners of Cook's membrane, mm."""


def slab(
    corners: tuple[Corner, Corner, Corner, Corner],
    cells: tuple[int, int],
    thickness: float = 1.0,
    order: int = 1,
) -> Mesh:
    """Return a convex quadrilateral extruded along z, for plane strain if set all has u_z = 0.

    Each cell is cut in four by both diagonals, which favours no direction, and each of the four
    prisms in three tetrahedra.

    Parameters
    ----------
    corners : the corners bottom left, bottom right, top right, top left in the plane, mm.
    cells : the numbers of cells from left to right and from bottom to top.
    thickness : the thickness, mm.
    order : the order of the elements, 1 or 2.

    Returns
    -------
    Mesh with node sets and facet sets left, right, bottom, top, front (z = 0), back
    (z = thickness), and the node set all.
    """
    if min(cells) < 1 or not thickness > 0.0:
        raise InputError(f"slab: cells {cells} and thickness {thickness} mm must be positive")
    square, triangles = _crossed_square(*cells)
    across, up = square.T
    weights = [(1 - across) * (1 - up), across * (1 - up), across * up, (1 - across) * up]
    plane = np.stack(weights, axis=1) @ _check_corners(corners)
    layer = np.repeat((0.0, 1.0), len(plane))
    nodes = np.column_stack([np.tile(plane, (2, 1)), thickness * layer])
    surfaces = {
        name: np.flatnonzero(x == end)
        for names, x in zip((_X, _Z, _Y), (*np.tile(square, (2, 1)).T, layer), strict=True)
        for end, name in enumerate(names)
    }
    mesh = body(nodes, extrude(stacked(len(plane), 1), triangles), surfaces, surfaces, None, order)
    return replace(mesh, node_sets={**mesh.node_sets, "all": np.arange(len(mesh.nodes))})


def cooks_membrane(cells: tuple[int, int] = (8, 8), thickness: float = 1.0, order: int = 1) -> Mesh:
    """Return Cook's membrane: :func:`slab` of ``COOKS_MEMBRANE``."""
    return slab(COOKS_MEMBRANE, cells, thickness, order)


def _check_corners(corners: tuple[Corner, ...]) -> np.ndarray:
    """Return the corners as (4, 2); refuse any that are not convex and anticlockwise."""
    points = np.asarray(corners, dtype=float)
    if points.shape != (4, 2) or not np.isfinite(points).all():
        raise InputError(f"slab: corners {corners}; expected four finite points (x, y)")
    sides = np.roll(points, -1, axis=0) - points
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    if turns.min() <= 0.0:
        raise InputError(
            f"slab: corners {corners} are not a convex quadrilateral; expected them anticlockwise"
        )
    return points


def _crossed_square(across: int, up: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit square of cells cut by both diagonals: points (v, 2), triangles (k, 3)."""
    i, j = np.meshgrid(np.arange(across + 1), np.arange(up + 1), indexing="ij")
    grid = np.column_stack([i.ravel() / across, j.ravel() / up])
    number = np.arange(len(grid)).reshape(across + 1, up + 1)
    ring = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    middle = len(grid) + np.arange(across * up)
    centres = np.mean([grid[corner.ravel()] for corner in ring], axis=0)
    triangles = [
        np.column_stack([a.ravel(), b.ravel(), middle])
        for a, b in zip(ring, ring[1:] + ring[:1], strict=True)
    ]
    return np.concatenate([grid, centres]), np.concatenate(triangles)
