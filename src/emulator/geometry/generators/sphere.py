"""Meshes of a ball and of one eighth of a thick sphere, cut along its planes of symmetry."""

from __future__ import annotations

from itertools import combinations, permutations, product

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body, extrude, stacked
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import Midpoints


def triangle_lattice(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a triangle cut into ``divisions**2``: barycentric points (v, 3), triangles (k, 3)."""
    n = divisions
    i, j = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]).T
    here, ahead = np.arange(len(i)), np.arange(len(i)) + n + 1 - i  # places of (i, j), (i + 1, j)
    upright = np.column_stack([here, ahead, here + 1])[i + j < n]
    between = np.column_stack([ahead, ahead + 1, here + 1])[i + j < n - 1]
    return np.column_stack([i, j, n - i - j]) / n, np.concatenate([upright, between])


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) at length one; the zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def ball_midpoints(nodes: np.ndarray) -> Midpoints:
    """Return midpoints of edges between ``nodes`` (n, 3), at the mean direction and radius.

    On an edge from the centre, which has no direction, the midpoint lies halfway along it.
    """
    directions = unit(nodes)
    radii = np.linalg.norm(nodes, axis=1)

    def midpoints(edges: np.ndarray) -> np.ndarray:
        return unit(directions[edges].sum(axis=1)) * radii[edges].mean(axis=1)[:, None]

    return midpoints


def ball(shells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n, 3) of the unit ball in ``shells`` shells, each a subdivided icosahedron.

    Shell k has 10 k^2 + 2 nodes. Also the tetrahedra (20 shells^3, 4), not oriented.
    """
    corners, faces = _icosahedron()
    steps, cells = _kuhn_lattice(shells)
    # Barycentric steps from the centre and the three corners of a face, (v, 4).
    weights = np.column_stack([shells - steps[:, 0], -np.diff(steps, axis=1), steps[:, 2]])
    flat = np.einsum("va,fai->fvi", weights[:, 1:], corners[faces]).reshape(-1, 3)
    # Neighbouring sectors share the nodes between them, equal but for round-off.
    _, first, number = np.unique(np.round(flat, 9), axis=0, return_index=True, return_inverse=True)
    shell = np.tile(steps[:, 0], len(faces))[first]
    sectors = cells[None] + len(steps) * np.arange(len(faces))[:, None, None]
    return unit(flat[first]) * (shell / shells)[:, None], number.reshape(-1)[sectors].reshape(-1, 4)


def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (12, 3) on the unit sphere and the faces (20, 3)."""
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    half = np.array([(0.0, a, b * golden) for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    corners = unit(np.concatenate([np.roll(half, turn, axis=1) for turn in range(3)]))
    adjacent = corners @ corners.T > 0.4  # neighbours' directions have cosine 1 / sqrt(5)
    faces = [each for each in combinations(range(12), 3) if adjacent[np.ix_(each, each)].all()]
    return corners, np.array(faces)


def _kuhn_lattice(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (v, 3), cells (c, 4) of ``divisions >= x >= y >= z >= 0`` in unit steps.

    Kuhn's six tetrahedra of each unit cube, those inside the simplex. They cut its faces into
    regular lattices, so simplices glued face to face fit.
    """
    cube = np.array(list(product(range(divisions), repeat=3)))
    paths = [
        np.vstack([np.zeros(3, dtype=int), np.cumsum(np.eye(3, dtype=int)[list(axes)], axis=0)])
        for axes in permutations(range(3))
    ]
    cells = np.concatenate([cube[:, None] + path for path in paths])  # (k, 4, 3)
    x, y, z = np.moveaxis(cells, -1, 0)
    inside = cells[((x >= y) & (y >= z)).all(axis=1)]
    points, number = np.unique(inside.reshape(-1, 3), axis=0, return_inverse=True)
    return points, number.reshape(-1, 4)


def sphere_octant(
    inner: float, outer: float, cells: tuple[int, int], grading: float = 1.0, order: int = 1
) -> Mesh:
    """Return the part of the shell ``inner <= |X| <= outer`` with x, y, z >= 0.

    Parameters
    ----------
    inner, outer : the radii in mm.
    cells : number along each edge of the spherical triangle, and through the wall.
    grading : the ratio of the outermost layer's thickness to the innermost layer's; layers grow
        geometrically.
    order : 1, or 2 for quadratic elements with their mid-edge nodes on the spheres.

    Returns
    -------
    Mesh with node sets and facet sets x, y, z (the planes x = 0, y = 0, z = 0), inner, outer.
    """
    if not 0.0 < inner < outer < np.inf:
        raise InputError(f"sphere: radii {inner} and {outer} mm; expected 0 < inner < outer")
    if min(cells) < 1 or not 0.0 < grading < np.inf:
        raise InputError(f"sphere: cells {cells} and grading {grading} must be positive")
    along, through = cells
    barycentric, triangles = triangle_lattice(along)
    directions = unit(barycentric)
    thickness = grading ** np.linspace(0.0, 1.0, through)
    within = np.concatenate([[0.0], np.cumsum(thickness)]) / thickness.sum()
    radii = inner + (outer - inner) * within
    nodes = (radii[:, None, None] * directions).reshape(-1, 3)
    level = np.repeat(np.arange(through + 1), len(directions))
    sets = {name: np.flatnonzero(nodes[:, axis] == 0.0) for axis, name in enumerate("xyz")}
    sets |= {"inner": np.flatnonzero(level == 0), "outer": np.flatnonzero(level == through)}
    elements = extrude(stacked(len(directions), through), triangles)
    return body(nodes, elements, sets, sets, ball_midpoints(nodes), order)
