"""Meshes of other libraries, as meshio has them: scikit-fem's, PyVista's and meshio's own.

None of these libraries is asked what a mesh is: it is what has their attributes.
"""

from __future__ import annotations

from typing import Any

import meshio
import numpy as np

from emulator.core.errors import InputError

# VTK's numbers of cell types, and meshio's names.
_VTK = {1: "vertex", 3: "line", 5: "triangle", 10: "tetra", 22: "triangle6", 24: "tetra10"}


def as_meshio(source: Any) -> meshio.Mesh:
    """A mesh of another library with its sets and its data.

    Parameters
    ----------
    source : a scikit-fem mesh of tetrahedra (its boundaries become facet sets), a PyVista
        ``UnstructuredGrid``, or a meshio ``Mesh``.

    Raises
    ------
    InputError
        Something else, or cells of a PyVista grid that are no simplices.
    """
    if hasattr(source, "doflocs") and hasattr(source, "boundaries"):
        return _from_skfem(source)
    if hasattr(source, "celltypes") and hasattr(source, "cells_dict"):
        return _from_pyvista(source)
    if hasattr(source, "points") and hasattr(source, "cell_sets"):
        return source
    raise InputError(
        f"a {type(source).__name__} is no mesh; give a file, a scikit-fem mesh, a PyVista "
        "UnstructuredGrid or a meshio Mesh"
    )


def _from_skfem(source: Any) -> meshio.Mesh:
    points, corners = np.asarray(source.doflocs).T, np.asarray(source.t).T
    if points.shape[1] != 3 or corners.shape[1] != 4:
        raise InputError(f"a scikit-fem {type(source).__name__} has no tetrahedra")
    nodes = np.asarray(source.dofs.element_dofs).T  # of MeshTet2, its nodes on edges too
    blocks = [("tetra10" if nodes.shape[1] == 10 else "tetra", nodes)]
    sets: dict[str, list[np.ndarray]] = {}
    named = source.boundaries or {}
    if named:
        blocks.append(("triangle", np.asarray(source.facets).T))
        none = np.empty(0, dtype=np.int64)
        sets = {name: [none, np.asarray(facets)] for name, facets in named.items()}
    return meshio.Mesh(points, blocks, cell_sets=sets)


def _from_pyvista(source: Any) -> meshio.Mesh:
    types = np.asarray(source.celltypes)
    unknown = sorted(set(types.tolist()) - set(_VTK))
    if unknown:
        raise InputError(
            f"the grid has cells of VTK's type {unknown[0]}; expected tetrahedra only: "
            "grid.triangulate() splits others"
        )
    kinds = {int(kind): np.asarray(cells) for kind, cells in source.cells_dict.items()}
    data = {
        name: [np.asarray(source.cell_data[name])[types == kind] for kind in kinds]
        for name in source.cell_data.keys()  # noqa: SIM118 - PyVista's data is no mapping
    }
    return meshio.Mesh(
        np.asarray(source.points),
        [(_VTK[kind], cells) for kind, cells in kinds.items()],
        cell_data=data,
        point_data={name: np.asarray(source.point_data[name]) for name in source.point_data.keys()},  # noqa: SIM118
    )
