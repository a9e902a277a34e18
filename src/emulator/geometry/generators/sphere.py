"""One eighth of a thick sphere, cut along its planes of symmetry."""

from __future__ import annotations

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.ball import ball_midpoints, triangle_lattice, unit
from emulator.geometry.generators.body import body
from emulator.geometry.generators.prisms import extrude, stacked
from emulator.geometry.mesh import Mesh


def sphere_octant(
    inner: float, outer: float, cells: tuple[int, int], grading: float = 1.0, order: int = 1
) -> Mesh:
    """The part of the shell ``inner <= |X| <= outer`` with x, y, z >= 0.

    Parameters
    ----------
    inner, outer : radii in mm.
    cells : number along each edge of the spherical triangle, and through the wall.
    grading : ratio of the outermost layer's thickness to the innermost layer's; layers grow
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
    radii = _radii(inner, outer, through, grading)
    nodes = (radii[:, None, None] * directions).reshape(-1, 3)
    level = np.repeat(np.arange(through + 1), len(directions))
    sets = {name: np.flatnonzero(nodes[:, axis] == 0.0) for axis, name in enumerate("xyz")}
    sets |= {"inner": np.flatnonzero(level == 0), "outer": np.flatnonzero(level == through)}
    elements = extrude(stacked(len(directions), through), triangles)
    return body(nodes, elements, sets, sets, ball_midpoints(nodes), order)


def _radii(inner: float, outer: float, through: int, grading: float) -> np.ndarray:
    """Radii of the layers, (through + 1,) mm."""
    thickness = grading ** np.linspace(0.0, 1.0, through)
    within = np.concatenate([[0.0], np.cumsum(thickness)]) / thickness.sum()
    return inner + (outer - inner) * within
