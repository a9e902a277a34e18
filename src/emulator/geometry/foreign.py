"""Meshes of other libraries and files as meshio has them, with their named groups as sets.

scikit-fem's, PyVista's and meshio's own meshes are recognised by their attributes; none of these
libraries is imported for it. Gmsh, Abaqus and others store names of groups differently: meshio
returns them as ``field_data`` with tags, ``cell_sets`` or ``point_sets``. In formats without named
sets (VTU, XDMF) a set is an array of 0 and 1 called ``set:<name>``, on triangles or on points.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import meshio
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, boundary_facets

# VTK's numbers of cell types, and meshio's names.
_VTK = {1: "vertex", 3: "line", 5: "triangle", 10: "tetra", 22: "triangle6", 24: "tetra10"}


def as_meshio(source: Any) -> meshio.Mesh:
    """Return a mesh of another library with its sets and its data.

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


MARK = "set:"
_TAG = "gmsh:physical"
_PLURAL = {0: "points", 1: "lines", 2: "triangles"}

Sets = dict[str, np.ndarray]


def read_sets(source: meshio.Mesh, number: np.ndarray, elements: np.ndarray) -> tuple[Sets, Sets]:
    """Return the node sets and facet sets of a mesh file.

    Groups of triangles become facet sets, their normals turned out of the body, and node sets of
    the same name. Groups of points and lines become node sets. Groups of volumes are left out.

    Parameters
    ----------
    source : the file as meshio reads it.
    number : the new number (n,) of each of its nodes, -1 for dropped nodes.
    elements : (m, 4 or 10) tetrahedra in the new numbers, positively oriented.

    Raises
    ------
    InputError
        A group without a name, or a triangle of a group that is not on the surface.
    """
    found_groups = _groups(source)
    facets = {name: rows for (name, dimension), rows in found_groups.items() if dimension == 2}
    facet_sets = _on_surface({name: number[rows] for name, rows in facets.items()}, elements)
    node_sets = {name: np.unique(rows) for name, rows in facet_sets.items()}
    points: dict[str, list[np.ndarray]] = {}
    for (name, dimension), rows in found_groups.items():
        if dimension < 2:
            points.setdefault(name, []).append(rows.ravel())
    for name, nodes in _point_sets(source):
        points.setdefault(name, []).append(nodes)
    for name, parts in points.items():
        nodes = np.unique(number[np.concatenate(parts)])
        node_sets[name] = nodes[nodes >= 0]
    return {name: nodes for name, nodes in node_sets.items() if nodes.size}, facet_sets


def own_node_sets(mesh: Mesh) -> Sets:
    """Return the node sets that do not follow from the facet set of the same name."""
    implied = {name: np.unique(facets) for name, facets in mesh.facet_sets.items()}
    return {
        name: nodes
        for name, nodes in mesh.node_sets.items()
        if name not in implied or not np.array_equal(np.unique(nodes), implied[name])
    }


def _groups(source: meshio.Mesh) -> dict[tuple[str, int], np.ndarray]:
    """Return ``(name, dimension)`` -> corner nodes (k, dimension + 1) of the group's cells."""
    parts: dict[tuple[str, int], list[np.ndarray]] = {}
    for k, block in enumerate(source.cells):
        if block.dim < 3:
            for name, cells in _named_cells(source, k):
                corners = np.asarray(block.data)[cells][:, : block.dim + 1]
                if len(corners):
                    parts.setdefault((name, block.dim), []).append(corners)
    return {key: np.concatenate(rows) for key, rows in parts.items()}


def _named_cells(source: meshio.Mesh, k: int) -> Iterator[tuple[str, np.ndarray]]:
    """Return the name and the members of every group in cell block ``k``."""
    for name, members in source.cell_sets.items():
        if name != "gmsh:bounding_entities" and members[k] is not None:
            yield name, np.asarray(members[k], dtype=np.int64)
    for name, data in source.cell_data.items():
        if name.startswith(MARK):
            yield name.removeprefix(MARK), np.flatnonzero(data[k])
    if _TAG in source.cell_data:
        yield from _tagged_cells(source, k)


def _tagged_cells(source: meshio.Mesh, k: int) -> Iterator[tuple[str, np.ndarray]]:
    dimension, tags = source.cells[k].dim, np.asarray(source.cell_data[_TAG][k])
    names = {tuple(map(int, entry)): name for name, entry in source.field_data.items()}
    for tag in np.unique(tags[tags != 0]).tolist():
        if (tag, dimension) not in names:
            raise InputError(
                f"physical group {tag} ({_PLURAL[dimension]}) has no name of its own; "
                "name it in the mesh generator ($PhysicalNames)"
            )
        yield names[tag, dimension], np.flatnonzero(tags == tag)


def _point_sets(source: meshio.Mesh) -> Iterator[tuple[str, np.ndarray]]:
    for name, nodes in source.point_sets.items():
        yield name, np.asarray(nodes, dtype=np.int64)
    for name, data in source.point_data.items():
        if name.startswith(MARK):
            yield name.removeprefix(MARK), np.flatnonzero(data)


def _on_surface(groups: Sets, elements: np.ndarray) -> Sets:
    """Return each triangle as ``boundary_facets`` lists it: facing out, with mid-edge nodes."""
    if not groups:
        return {}
    surface = {tuple(sorted(row[:3])): row for row in boundary_facets(elements).tolist()}
    sets = {}
    for name, rows in groups.items():
        corners = np.unique(np.sort(rows, axis=1), axis=0).tolist()
        inside = sum(tuple(row) not in surface for row in corners)
        if inside:
            raise InputError(
                f"{inside} of the {len(corners)} triangles in group '{name}' are not on the "
                "surface of the tetrahedra; a group of triangles must lie on it"
            )
        sets[name] = np.array([surface[tuple(row)] for row in corners])
    return sets
