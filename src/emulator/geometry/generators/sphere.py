"""Meshes of a ball, an organ made of it, and one eighth of a thick sphere, cut along its planes."""

from __future__ import annotations

from itertools import combinations, permutations, product

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body, extrude, stacked
from emulator.geometry.mesh import Mesh, boundary_facets, orient
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
    faces = [row for row in combinations(range(12), 3) if adjacent[np.ix_(row, row)].all()]
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


# One lobe is thick and high, the other tapers; the underside is hollow.
_TAPER_Y, _TAPER_Z, _BEND = 0.35, 0.5, 0.3
# The ligament holds the top, to the side of the thick lobe.
_LIGAMENT_DIRECTION = np.array([-0.4, -0.3, np.sqrt(0.75)])
_LIGAMENT_HALF_ANGLE = np.radians(32.0)


def organ(
    half_axes: tuple[float, float, float] = (75.0, 45.0, 38.0),
    shells: int = 6,
    order: int = 1,
    clustering: float = 0.0,
    ligament_shells: int = 6,
) -> Mesh:
    r"""Return a liver-like body, a ball mapped to a lobed, bent shape; dimensions are our choice.

    .. math:: X = a\,x, \qquad Y = b\,(1 - \tau x)\,y + \beta b\,x^2, \qquad
              Z = c\,(1 - \sigma x)\,z - \beta c\,x^2

    for :math:`|(x, y, z)| \le 1`. The map is triangular, so its determinant
    :math:`abc\,(1 - \tau x)(1 - \sigma x)` is positive, and the volume is
    :math:`\tfrac{4}{3}\pi abc\,(1 + \tau\sigma/5)`.

    Parameters
    ----------
    half_axes : a, b, c in mm.
    shells : the number of shells of the ball that is mapped; 6 give 923 nodes.
    order : 1, or 2 for quadratic elements with their mid-edge nodes on the true surface.
    clustering : above 0, below 1: elements at the ligament are smaller, by (1 - c) / (1 + c), and
        larger on the other side, none distorted: the ball is moved by a Moebius map.
    ligament_shells : the ligament is made of facets of the mesh of this many shells, whatever
        ``shells`` is. Meshes of a multiple cover it exactly; solutions of others do not converge to
        the same limit.

    Returns
    -------
    Mesh with node set and facet set ligament, a patch of the surface to hold, and facet set
    surface.
    """
    if not 0.0 < min(half_axes) <= max(half_axes) < np.inf:
        raise InputError(f"organ: half axes {half_axes} mm must be positive and finite")
    if shells < 2:
        raise InputError(f"organ: {shells} shells; expected at least 2")
    nodes, elements = ball(shells)
    surface = np.flatnonzero(np.linalg.norm(nodes, axis=1) > 1.0 - 0.5 / shells)
    if not 0.0 <= clustering < 1.0:
        raise InputError(f"organ: clustering {clustering}; expected from 0 to below 1")
    in_ligament = _in_ligament(nodes[surface], ligament_shells, clustering)
    middle = ball_midpoints(nodes)

    def mapped(points: np.ndarray) -> np.ndarray:
        return _shape(_moebius(points, clustering), half_axes)

    return body(
        mapped(nodes),
        elements,
        {"surface": surface, "ligament": surface[in_ligament]},
        {"ligament": surface[in_ligament]},
        lambda edges: mapped(middle(edges)),
        order,
    )


def _in_ligament(directions: np.ndarray, shells: int, clustering: float) -> np.ndarray:
    """Return whether each unit vector (k, 3) meets the ligament before the map, (k,) bool."""
    nodes, elements = ball(shells)
    triangles = boundary_facets(orient(nodes, elements))
    inside = _moebius(nodes, clustering) @ _LIGAMENT_DIRECTION > np.cos(_LIGAMENT_HALF_ANGLE)
    corners = nodes[triangles[inside[triangles].all(axis=1)]]  # (t, 3, 3)
    # A vector meets a triangle where it is a sum of its corners with no negative weight.
    weights = np.einsum("ki,tij->tkj", directions, np.linalg.inv(corners))
    return (weights > -1e-9).all(axis=2).any(axis=0)


def _moebius(points: np.ndarray, clustering: float) -> np.ndarray:
    r"""Return the Moebius map of the unit ball that takes its centre to :math:`a = c\, d`, (k, 3).

    .. math:: T(x) = \frac{(1 + 2 a \cdot x + |x|^2)\, a + (1 - |a|^2)\, x}
                          {1 + 2 a \cdot x + |a|^2 |x|^2}

    with the ligament's direction :math:`d`. It keeps all angles (Ratcliffe 2019, Section 4.5).
    """
    a = clustering * _LIGAMENT_DIRECTION
    along, square = 2.0 * (points @ a)[:, None], np.sum(points**2, axis=1)[:, None]
    numerator = (1.0 + along + square) * a + (1.0 - clustering**2) * points
    return numerator / (1.0 + along + clustering**2 * square)


def _shape(points: np.ndarray, half_axes: tuple[float, float, float]) -> np.ndarray:
    """Return the map of this module, (k, 3) of the unit ball to (k, 3) in mm."""
    x, y, z = points.T
    a, b, c = half_axes
    return np.column_stack(
        [
            a * x,
            b * ((1.0 - _TAPER_Y * x) * y + _BEND * x**2),
            c * ((1.0 - _TAPER_Z * x) * z - _BEND * x**2),
        ]
    )
