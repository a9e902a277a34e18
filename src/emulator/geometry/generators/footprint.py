"""A triangulated sheet opened along a line, for the wall of a second sheet to stand in the gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skfem import Basis, ElementTriP1, MeshTri, condense, solve
from skfem.models.poisson import laplace


@dataclass(frozen=True, eq=False)
class Footprint:
    """A sheet opened along a line; the gap is filled by a band of one strip for each level.

    origin : for each vertex, old ones first, the old vertex it is or was copied from.
    line : (p,) old vertices along which the sheet was opened.
    levels : (p, strips + 1) copies of ``line`` on each line of the band; column 0 is ``line``.
    inner : (k, 3) triangles on the near side of the line.
    outer : (k, 3) triangles on the far side, attached to the band's last line.
    band : (k, 3) triangles of the band, cut along the same diagonals as the sides of ``inner``
        extruded through ``strips`` layers (:func:`emulator.geometry.generators.prisms.extrude`).
    """

    origin: np.ndarray
    line: np.ndarray
    levels: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    band: np.ndarray


def open_sheet(triangles: np.ndarray, inside: np.ndarray, strips: int) -> Footprint:
    """Open a sheet around the triangles whose vertices are all ``inside`` (v,).

    The new vertices are numbered after the old ones, line by line.
    """
    near = inside[triangles].all(axis=1)
    edges = np.intersect1d(_edge_keys(triangles[near]), _edge_keys(triangles[~near]))
    ends = np.column_stack(np.divmod(edges, _KEY))  # lower vertex first, as extrude sorts them
    line = np.unique(ends)
    levels = len(inside) + np.arange(len(line) * strips).reshape(strips, len(line)).T
    levels = np.column_stack([line, levels])
    moved = np.arange(len(inside))
    moved[line] = levels[:, -1]
    a, b = levels[np.searchsorted(line, ends)].swapaxes(0, 1)
    a0, a1, b0, b1 = (part.ravel() for part in (a[:, :-1], a[:, 1:], b[:, :-1], b[:, 1:]))
    band = np.concatenate([np.column_stack([a0, b0, b1]), np.column_stack([a0, a1, b1])])
    origin = np.concatenate([np.arange(len(inside)), np.tile(line, strips)])
    return Footprint(origin, line, levels, triangles[near], moved[triangles[~near]], band)


_KEY = 1 << 31


def _edge_keys(triangles: np.ndarray) -> np.ndarray:
    """One number for each edge of triangles, whichever triangle it is seen from."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges[:, 0] * _KEY + edges[:, 1])


def spread(
    points: np.ndarray, triangles: np.ndarray, held: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """``points`` (v, 2) with ``held`` (h,) moved to ``places`` (h, 2) and the others following.

    Displacements are harmonic over ``triangles``: they decay away from ``held`` and keep an even
    grid even. Points outside the triangles stay.
    """
    used, local = np.unique(triangles, return_inverse=True)
    basis = Basis(MeshTri(points[used].T.copy(), local.reshape(-1, 3).T.copy()), ElementTriP1())
    stiffness = laplace.assemble(basis)
    fixed = np.searchsorted(used, held)
    result = points.copy()
    for axis in range(2):
        shift = basis.zeros()
        shift[fixed] = (places - points[held])[:, axis]
        result[used, axis] += solve(*condense(stiffness, x=shift, D=fixed))
    return result
