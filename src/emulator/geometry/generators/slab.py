"""Plane-strain bodies: a quadrilateral one cell thick."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body
from emulator.geometry.generators.prisms import extrude, stacked
from emulator.geometry.mesh import Mesh

Corner = tuple[float, float]
COOKS_MEMBRANE: tuple[Corner, Corner, Corner, Corner] = ((0, 0), (48, 44), (48, 60), (0, 44))
"""Corners of Cook's membrane, mm."""


def slab(
    corners: tuple[Corner, Corner, Corner, Corner],
    cells: tuple[int, int],
    thickness: float = 1.0,
    order: int = 1,
) -> Mesh:
    """A convex quadrilateral extruded along z, for plane strain with u_z held on node set all.

    Each cell is cut in four by both diagonals, which favours no direction, and each of the four
    prisms in three tetrahedra.

    Parameters
    ----------
    corners : bottom left, bottom right, top right, top left in the plane, mm.
    cells : number from left to right and from bottom to top.
    thickness : mm.
    order : 1, or 2 for quadratic elements.

    Returns
    -------
    Mesh with node sets and facet sets left, right, bottom, top, front (z = 0), back
    (z = thickness), and the node set all.
    """
    if min(cells) < 1 or not thickness > 0.0:
        raise InputError(f"slab: cells {cells} and thickness {thickness} mm must be positive")
    square, triangles = _crossed_square(*cells)
    plane = _bilinear(_checked(corners), square)
    nodes = np.concatenate(
        [np.column_stack([plane, np.full(len(plane), z)]) for z in (0, thickness)]
    )
    across, up = np.tile(square, (2, 1)).T
    on = {
        "left": across == 0.0,
        "right": across == 1.0,
        "bottom": up == 0.0,
        "top": up == 1.0,
        "front": nodes[:, 2] == 0.0,
        "back": nodes[:, 2] > 0.0,
    }
    surfaces = {name: np.flatnonzero(chosen) for name, chosen in on.items()}
    mesh = body(nodes, extrude(stacked(len(plane), 1), triangles), surfaces, surfaces, None, order)
    return replace(mesh, node_sets={**mesh.node_sets, "all": np.arange(len(mesh.nodes))})


def cooks_membrane(cells: tuple[int, int] = (8, 8), thickness: float = 1.0, order: int = 1) -> Mesh:
    """Cook's membrane: :func:`slab` of ``COOKS_MEMBRANE``."""
    return slab(COOKS_MEMBRANE, cells, thickness, order)


def _checked(corners: tuple[Corner, ...]) -> np.ndarray:
    """The corners as (4, 2), convex and anticlockwise."""
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


def _bilinear(corners: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Points (v, 2) of the quadrilateral at coordinates (v, 2) of the unit square."""
    across, up = square.T
    weights = [(1 - across) * (1 - up), across * (1 - up), across * up, (1 - across) * up]
    return np.stack(weights, axis=1) @ corners


def _crossed_square(across: int, up: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit square of cells cut by both diagonals: points (v, 2), triangles (k, 3)."""
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
