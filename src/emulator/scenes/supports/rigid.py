"""Rigid motions that supports leave to a body, or to a part of one that is not connected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, parts
from emulator.scenes.supports.boundary_condition import BoundaryCondition


def check_motions(name: str, mesh: Mesh, supports: Sequence[BoundaryCondition]) -> None:
    """Refuse supports of the scene ``name`` that let a part of the body move or turn."""
    resisted = [support.resisted(mesh) for support in supports]
    points = np.concatenate([each.points for each in resisted])
    directions = np.concatenate([each.directions for each in resisted])
    part = parts(mesh.elements, len(mesh.nodes))
    owner = part[cKDTree(mesh.nodes).query(points)[1]]
    for k in range(part.max() + 1):
        free = free_motions(points[owner == k], directions[owner == k])
        if free:
            which = _named(mesh.nodes, part, k) if part.any() else "its supports leave"
            raise InputError(
                f"scene '{name}': {which} {free} of the 6 rigid motions free, the body could move "
                "or turn; hold more nodes or components"
            )


def _named(nodes: np.ndarray, part: np.ndarray, k: int) -> str:
    inside = nodes[part == k]
    x, y, z = inside.mean(axis=0)
    return (
        f"the mesh has {part.max() + 1} parts, and supports leave the one of {len(inside)} nodes "
        f"about ({x:.3g}, {y:.3g}, {z:.3g}) mm"
    )


def free_motions(points: np.ndarray, directions: np.ndarray) -> int:
    """How many of the six rigid motions remain.

    ``points`` (k, 3) cannot move along ``directions`` (k, 3). A small rigid motion ``a + w x X``
    moves a point along its direction by ``a . d + w . (X x d)``; the rank of these rows is the
    number of motions stopped.
    """
    if not len(points):
        return 6
    centred = points - points.mean(axis=0)
    size = np.linalg.norm(np.ptp(points, axis=0))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.hstack([unit, np.cross(centred, unit) / (size if size > 0.0 else 1.0)])
    return 6 - int(np.linalg.matrix_rank(rows.T @ rows, tol=1e-12 * len(rows), hermitian=True))
