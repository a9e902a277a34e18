"""Structured mesh of a box."""

from __future__ import annotations

import numpy as np
from skfem import MeshTet

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body
from emulator.geometry.mesh import Mesh

_FACES = (
    ("left", 0, 0),
    ("right", 0, 1),
    ("front", 1, 0),
    ("back", 1, 1),
    ("bottom", 2, 0),
    ("top", 2, 1),
)


def toward_ends(count: int, grading: float, ends: tuple[str, ...]) -> np.ndarray:
    """Ends (count + 1,) of cells on [0, 1], closer at some of its ends.

    Cell k of n ends at :math:`(k/n)^g` where ``left`` is to be fine; likewise from the ``right``,
    and from both ends to the middle.

    Parameters
    ----------
    grading : the exponent g; 1 is even, and more is finer at the ends.
    ends : ``left``, ``right`` or both.

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
    """Structured box ``[0, lengths]`` of six tetrahedra a cell, nodes numbered x first, then y, z.

    Parameters
    ----------
    lengths : edge lengths in mm.
    cells : number of cells along x, y, z.
    order : 1, or 2 for quadratic elements.
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
        name: np.flatnonzero(nodes[:, axis] == (axes[axis][0], axes[axis][-1])[end])
        for name, axis, end in _FACES
    }
    return body(nodes, elements, sets, sets, None, order)
