r"""Hexahedra, prisms and pyramids as tetrahedra.

A quadrilateral is cut by the diagonal from its corner of the smallest number, so that the cells on
both sides of a face cut it alike; a cell becomes the tetrahedra from its own smallest corner to the
triangles of the faces that do not have that corner (Dompierre, Labbé, Vallet and Camarero 1999, How
to subdivide pyramids, prisms and hexahedra into tetrahedra). A hexahedron gives six, a prism three
and a pyramid two. Corners are numbered as VTK, Abaqus and FEBio do.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import meshio
import numpy as np

FACES = {
    5: ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    6: ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    8: ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}
"""The corners of the faces of a cell, by its number of corners, in the order of Abaqus's faces."""
SPLIT = frozenset({"pyramid", "wedge", "hexahedron"})
"""meshio's names of the cells that are split."""


def triangles_of(quadrilaterals: np.ndarray) -> np.ndarray:
    """Return the triangles (2 k, 3) of quadrilaterals (k, 4), two after each other."""
    first = np.argmin(quadrilaterals, axis=1)[:, None]
    corners = np.take_along_axis(quadrilaterals, (first + np.arange(4)) % 4, axis=1)
    return corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def tetrahedra_of(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tetrahedra (t, 4) of cells (m, 5, 6 or 8), and the row (t,) of the cell of each.

    The tetrahedra of a cell come one after the other, and are not oriented. A cell has fewer of
    them where a corner is there twice: a hexahedron may be a prism.
    """
    first, numbers = cells.min(axis=1), np.arange(len(cells))
    rows, parents = [np.empty((0, 4), cells.dtype)], [numbers[:0]]
    for face in FACES[cells.shape[1]]:
        corners = cells[:, face]
        apart = (corners != first[:, None]).all(axis=1)
        of = numbers[apart]
        triangles = corners[apart]
        if len(face) == 4:
            triangles, of = triangles_of(triangles), np.repeat(of, 2)
        rows.append(np.column_stack([first[of], triangles]))
        parents.append(of)
    tetrahedra, of = np.concatenate(rows), np.concatenate(parents)
    whole = (np.diff(np.sort(tetrahedra, axis=1), axis=1) != 0).all(axis=1)
    order = np.argsort(of[whole], kind="stable")
    return tetrahedra[whole][order], of[whole][order]


def as_tetrahedra(content: meshio.Mesh) -> meshio.Mesh:
    """Return the content of a mesh file with its linear cells split, and their data with them."""
    cells, parents = [], []
    for block in content.cells:
        kind, rows = block.type, np.asarray(block.data)
        of = np.arange(len(rows))
        if kind in SPLIT:
            kind, (rows, of) = "tetra", tetrahedra_of(rows)
        elif kind == "quad":
            kind, rows, of = "triangle", triangles_of(rows), np.repeat(of, 2)
        cells.append((kind, rows))
        parents.append(of)
    kinds = ", ".join(sorted({block.type for block in content.cells} & SPLIT))
    split = copy(content)
    split.info = [*(content.info or []), f"{kinds} cells as such: they are split into tetrahedra"]
    split.cells = [meshio.CellBlock(kind, rows) for kind, rows in cells]
    split.cell_data = {name: _repeated(of, parents) for name, of in content.cell_data.items()}
    split.cell_sets = {name: _members(of, parents) for name, of in content.cell_sets.items()}
    return split


def _repeated(data: Sequence[np.ndarray], parents: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [np.asarray(values)[of] for values, of in zip(data, parents, strict=True)]


def _members(
    sets: Sequence[np.ndarray | None], parents: Sequence[np.ndarray]
) -> list[np.ndarray | None]:
    """Return the rows of the parts of the cells that each block's set has."""
    return [
        None if rows is None else np.flatnonzero(np.isin(of, np.asarray(rows)))
        for rows, of in zip(sets, parents, strict=True)
    ]
