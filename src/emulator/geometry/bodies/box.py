"""Structured mesh of a box."""

from __future__ import annotations

import numpy as np
from skfem import MeshTet

from emulator.errors import InputError
from emulator.geometry.bodies.body import body
from emulator.geometry.mesh import Mesh

_FACES = (
    ("left", 0, 0),
    ("right", 0, 1),
    ("front", 1, 0),
    ("back", 1, 1),
    ("bottom", 2, 0),
    ("top", 2, 1),
)


def box(lengths: tuple[float, float, float], cells: tuple[int, int, int], order: int = 1) -> Mesh:
    """Structured box ``[0, lengths]`` of six tetrahedra a cell, nodes numbered x first, then y, z.

    Parameters
    ----------
    lengths : edge lengths in mm.
    cells : number of cells along x, y, z.
    order : 1, or 2 for quadratic elements.

    Returns
    -------
    Mesh with node sets and facet sets left/right (x), front/back (y), bottom/top (z).
    """
    if min(lengths) <= 0.0 or min(cells) < 1:
        raise InputError(f"box: lengths {lengths} and cells {cells} must be positive")
    axes = [
        np.linspace(0.0, length, count + 1) for length, count in zip(lengths, cells, strict=True)
    ]
    grid = MeshTet.init_tensor(*axes)
    nodes, elements = grid.p.T, grid.t.T
    listed = np.lexsort(nodes.T)  # the last key, z, is the slowest
    rank = np.argsort(listed)
    nodes, elements = nodes[listed], rank[elements]
    sets = {
        name: np.flatnonzero(nodes[:, axis] == (axes[axis][0], axes[axis][-1])[end])
        for name, axis, end in _FACES
    }
    return body(nodes, elements, sets, sets, None, order)
