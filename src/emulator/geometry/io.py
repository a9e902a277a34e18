"""Meshes in and out of files with their named sets, deformed bodies out to VTU, through meshio.

scikit-fem's, PyVista's and meshio's own meshes are recognised by their attributes; none of these
libraries is imported for it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import replacing
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.fibres import across, from_elements, from_nodes
from emulator.geometry.file_formats import MARK, TAG, Sets, read_cells, read_sets, tag_array, unused
from emulator.geometry.mesh import Mesh, coincident, find_rows, orient
from emulator.geometry.refinement import to_quadratic
from emulator.geometry.splitting import SPLIT, as_tetrahedra

# meshio's cells by the elements' order: (tetrahedron, triangle).
_CELLS = {1: ("tetra", "triangle"), 2: ("tetra10", "triangle6")}
_LOWER = {"triangle", "triangle6", "line", "line3", "vertex"}
# VTK's numbers of cell types, and meshio's names.
_VTK = {1: "vertex", 3: "line", 5: "triangle", 9: "quad", 10: "tetra", 12: "hexahedron",
        13: "wedge", 14: "pyramid", 22: "triangle6", 24: "tetra10"}  # fmt: skip
# Names of directions, in any case.
_NAMES = {
    "fibres": r"(fib(er|re)?s?([ _-]?(dir|vec|orient|ax[ei]s|field)\w*)?|f[ _]?0)",
    "sheets": r"(sheets?([ _-]?(dir|vec|orient|ax[ei]s|field)\w*)?|s[ _]?0)",
}
# A direction whose length differs from 1 by more is refused; single precision stays far below.
_UNIT = 1e-3
# Fibres and sheets that were interpolated are made orthogonal again, if the cosine between them is
# below this at nine points in ten: at a jump, as between two walls, it may be anything.
_SKEW = 0.2


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh with fibres and sheets at its elements' quadrature points.

    Both are (m, 3) on a linear mesh and (m, q, 3) on a quadratic one; ``None`` where the file has
    none. ``unused`` has a phrase for each group and each array of the file that is in none of them.
    """

    mesh: Mesh
    fibres: np.ndarray | None = None
    sheets: np.ndarray | None = None
    unused: tuple[str, ...] = ()


def read_mesh(source: str | Path | Any) -> Mesh:
    """Return tetrahedra and named sets from any file meshio reads, lengths taken as mm.

    Or from a mesh of scikit-fem (its boundaries become facet sets), an ``UnstructuredGrid`` of
    PyVista or a ``Mesh`` of meshio.

    Groups of triangles become facet sets and node sets, groups of lines and points node sets.
    Nodes of no tetrahedron are dropped and inverted tetrahedra are turned. Linear hexahedra, prisms
    and pyramids are split (:mod:`emulator.geometry.splitting`).

    Raises
    ------
    InputError
        Missing or unreadable file, other cells, a group without a name, a group
        off the surface, or a mesh :class:`Mesh` refuses.
    """
    with _content(source) as content:
        return _mesh(content)[0]


def read_body(source: str | Path | Any, *, quadratic: bool = False) -> Body:
    """Return the mesh as :func:`read_mesh` returns it, with its ``fibres`` and ``sheets``.

    Both are data of points, or of cells: (m, 3), or (m, 3 q) for all quadrature points, also under
    other programs' names such as ``fiber``, ``FIB_DIR`` and ``f0``. Point and cell data are
    interpolated at the quadrature points (:mod:`emulator.geometry.fibres`); cell data of linear
    elements is taken as it is.

    Parameters
    ----------
    quadratic : make a linear mesh quadratic, its edges straight.

    Raises
    ------
    InputError
        As :func:`read_mesh`, or a direction that is not a unit vector.
    """
    with _content(source) as content:
        mesh, numbers, left = _mesh(content)
        order = 2 if quadratic else mesh.order
        directions: dict[str, np.ndarray | None] = dict.fromkeys(_NAMES)
        used = [tag_array(content)[0]]
        for kind, pattern in _NAMES.items():
            names = (kind, *content.cell_data, *content.point_data)
            for name in (label for label in names if re.fullmatch(pattern, label, re.IGNORECASE)):
                try:
                    directions[kind] = _directions(content, mesh, numbers, name, order)
                except InputError as error:
                    if name == kind:
                        raise
                    left.append(str(error))
                    used.append(name)
                if directions[kind] is not None:
                    used.append(name)
                    break
        fibres, sheets = directions.values()
        if fibres is not None and sheets is not None and fibres.ndim == 3:
            # Interpolation does not preserve orthogonality.
            skew = np.quantile(np.abs(np.sum(fibres * sheets, axis=-1)), 0.9)
            sheets = across(sheets, fibres) if skew < _SKEW else sheets
        left += unused(content, _CELLS[mesh.order][0], used)
        mesh = mesh if order == mesh.order else to_quadratic(mesh)
        return Body(mesh, fibres, sheets, tuple(left))


def read_regions(path: str | Path, name: str) -> np.ndarray:
    """Return the whole number (m,) of each element of a file from its cell data ``name``."""
    with _content(path) as content:
        values = _cell_data(content, name, "regions")
        if values.ndim != 1 or not (values == np.round(values)).all():
            raise InputError(f"'{name}' are not one whole number for each element")
        return values.astype(np.int64)


def read_modes(path: str | Path, name: str) -> np.ndarray:
    """Return modes of stiffness (m, k) of a file from its cell data ``name``."""
    with _content(path) as content:
        values = _cell_data(content, name, "stiffness modes")
        return values.reshape(len(values), -1).astype(float)


def _cell_data(content: meshio.Mesh, name: str, what: str) -> np.ndarray:
    if name not in content.cell_data:
        names = ", ".join(f"'{key}'" for key in content.cell_data) or "none"
        raise InputError(f"it has no cell data '{name}' for {what}; has {names}")
    return content.get_cell_data(name, _tetrahedra(content))


def write_mesh(
    path: str | Path,
    mesh: Mesh,
    fibres: np.ndarray | None = None,
    sheets: np.ndarray | None = None,
    regions: np.ndarray | None = None,
    stiffness_modes: np.ndarray | None = None,
) -> None:
    """Write mesh, named sets and directions, to be read back by :func:`read_body`.

    Parameters
    ----------
    path : ends in .vtu, .xdmf or .msh (gmsh 2.2, sets as physical groups).
    mesh : in mm.
    fibres, sheets : unit directions (m, 3) or (m, q, 3), the latter written as 3 q components; not
        in .msh, where meshio cannot read them.
    regions, stiffness_modes : the whole number (m,) and the modes (m, k) of each element, as cell
        data of these names; not in .msh either.

    Raises
    ------
    InputError
        Another suffix, or data the format cannot hold: for .msh, directions, or different nodes in
        a node set and a facet set of one name; for .xdmf, facet sets of a quadratic mesh.
    """
    directions = {
        name: _flat(np.asarray(values))
        for name, values in (
            ("fibres", fibres),
            ("sheets", sheets),
            ("regions", regions),
            ("stiffness_modes", stiffness_modes),
        )
        if values is not None
    }
    file, suffix, node_sets = f"mesh file {path}", Path(path).suffix, _own_node_sets(mesh)
    both = next((name for name in node_sets if name in mesh.facet_sets), None)
    if suffix not in (".msh", ".vtu", ".xdmf"):
        raise InputError(f"{file}: cannot write '{suffix}'; use .msh, .vtu or .xdmf")
    if suffix == ".xdmf" and mesh.order == 2 and mesh.facet_sets:
        raise InputError(f"{file}: .xdmf cannot hold quadratic facet sets; use .vtu")
    if suffix == ".msh" and directions:
        raise InputError(f"{file}: .msh cannot hold {', '.join(directions)}; use .vtu")
    if suffix == ".msh" and both is not None:
        raise InputError(
            f"{file}: facet set '{both}' and node set '{both}' have different nodes; "
            "give them different names or use .vtu"
        )
    options: dict[str, Any]
    if suffix == ".msh":
        content, options = _with_tags(mesh, node_sets), {"file_format": "gmsh22", "binary": True}
    else:
        content, options = _with_marks(mesh, node_sets, directions), {"file_format": suffix[1:]}
        if suffix == ".xdmf":  # by default to a second file, named after the temporary one
            options["data_format"] = "XML"
    with replacing(path) as temporary:
        meshio.write(temporary, content, **options)


def write_solution(
    path: str | Path, mesh: Mesh, displacement: np.ndarray, fields: Mapping[str, np.ndarray] = {}
) -> None:
    """Write a deformed body as VTU, whole or not at all.

    Parameters
    ----------
    mesh : the reference body, mm.
    displacement : (n, 3) mm.
    fields : cell data (m,), (m, 3) or (m, 3, 3), the last written as nine components, row by row;
        :func:`emulator.fem.fields.element_fields` computes them from a solution.
    """
    cells = {}
    for name, values in fields.items():
        cells[name] = [_flat(np.asarray(values))]
    write_vtu(path, mesh, point_data={"displacement": np.asarray(displacement)}, cell_data=cells)


def _flat(array: np.ndarray) -> np.ndarray:
    """Return cell data (m, ...) with one axis of components at most."""
    return array.reshape(len(array), -1) if array.ndim > 2 else array


def write_vtu(path: str | Path, mesh: Mesh, **data: Any) -> None:
    """Write ``mesh`` with meshio's ``point_data`` and ``cell_data``, whole or not at all."""
    output = meshio.Mesh(mesh.nodes, [(_CELLS[mesh.order][0], mesh.elements)], **data)
    with replacing(path) as temporary:
        meshio.write(temporary, output, file_format="vtu")


@contextmanager
def _content(source: str | Path | Any) -> Iterator[meshio.Mesh]:
    """Yield a file or a mesh of another library as meshio has it; errors then name the source."""
    is_file = isinstance(source, str | Path)
    content = read_cells(Path(source)) if is_file else _as_meshio(source)
    try:
        others = not SPLIT.isdisjoint(block.type for block in content.cells)
        yield as_tetrahedra(content) if others else content
    except InputError as error:
        name = f"mesh file {source}" if is_file else f"mesh ({type(source).__name__})"
        raise InputError(f"{name}: {str(error).removeprefix('mesh: ')}") from error


def _as_meshio(source: Any) -> meshio.Mesh:
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
    none = np.empty(0, dtype=np.int64)
    sets = {name: [none, np.asarray(rows)] for name, rows in (source.boundaries or {}).items()}
    if sets:
        blocks.append(("triangle", np.asarray(source.facets).T))
    return meshio.Mesh(points, blocks, cell_sets=sets)


def _from_pyvista(source: Any) -> meshio.Mesh:
    types = np.asarray(source.celltypes)
    if unknown := sorted(set(types.tolist()) - set(_VTK)):
        raise InputError(
            f"the grid has cells of VTK's type {unknown[0]}; expected tetrahedra only: "
            "grid.triangulate() splits others"
        )
    kinds = {int(kind): np.asarray(cells) for kind, cells in source.cells_dict.items()}
    # PyVista's data is no mapping, but has keys.
    of_cells, of_points = (
        {name: np.asarray(data[name]) for name in [*data.keys()]}
        for data in (source.cell_data, source.point_data)
    )
    return meshio.Mesh(
        np.asarray(source.points),
        [(_VTK[kind], cells) for kind, cells in kinds.items()],
        cell_data={name: [x[types == kind] for kind in kinds] for name, x in of_cells.items()},
        point_data=of_points,
    )


def _mesh(content: meshio.Mesh) -> tuple[Mesh, np.ndarray, list[str]]:
    """Return the mesh, the file's number (n,) of each of its nodes, and groups left out."""
    kind = _tetrahedra(content)
    elements = content.get_cells_type(kind)
    numbers, points = np.unique(elements), np.asarray(content.points, dtype=float)
    if numbers[0] < 0 or numbers[-1] >= len(points):
        return Mesh(points, elements), numbers, []  # raises InputError and names the range
    number = np.full(len(points), -1)
    number[numbers] = np.arange(len(numbers))
    nodes = points[numbers]
    elements = orient(nodes, number[elements])
    node_sets, facet_sets, left = read_sets(content, number, elements)
    mesh = Mesh(nodes, elements, node_sets, facet_sets)
    pairs = coincident(nodes)
    if len(pairs):
        one, other = np.sort(numbers[pairs[0]])
        raise InputError(
            f"its nodes {one} and {other} are at the same place, {len(pairs)} such pairs, so that "
            "what touches there is not joined; merge them"
        )
    return mesh, numbers, left


def _tetrahedra(content: meshio.Mesh) -> str:
    """Return the one type of tetrahedra in the file; :class:`InputError` names any other cells."""
    kinds = sorted({block.type for block in content.cells if len(block.data)})
    solid = [kind for kind in kinds if kind in ("tetra", "tetra10")]
    if other := [kind for kind in kinds if kind not in (*solid, *_LOWER)]:
        raise InputError(
            f"it has {', '.join(other)} cells; expected tetrahedra (tetra or tetra10), or linear "
            "hexahedra, prisms and pyramids: mesh the volume with them"
        )
    if not solid:
        raise InputError(
            f"it has no tetrahedra, only {', '.join(kinds) or 'no cells'}; mesh the volume, and "
            "give it a physical group if the surface has one, or gmsh leaves it out"
        )
    if len(solid) > 1:
        raise InputError("it has both tetra and tetra10 cells; expected one of the two")
    return solid[0]


def _directions(
    content: meshio.Mesh, mesh: Mesh, numbers: np.ndarray, name: str, order: int
) -> np.ndarray | None:
    """Return unit vectors at the elements' points from cell or point data ``name``."""
    if name in content.cell_data:
        values = content.get_cell_data(name, _CELLS[mesh.order][0])
        points = len(quadrature_points(order))
        if points > 1 and values.shape[1:] == (3 * points,):
            at_points = _check_lengths(values.reshape(-1, 3), name, "quadrature point")
            return at_points.reshape(-1, points, 3)
        of_elements = _check_lengths(values, name, "element")
        return of_elements if order == 1 else from_elements(mesh, of_elements)
    if name in content.point_data:
        at_nodes = _check_lengths(np.asarray(content.point_data[name])[numbers], name, "node")
        at_points = from_nodes(mesh, at_nodes, order)
        return at_points[:, 0] if order == 1 else at_points
    return None


def _check_lengths(values: np.ndarray, name: str, where: str) -> np.ndarray:
    """Return vectors (k, 3) scaled to length one; refuse lengths off by more than round-off."""
    values = np.asarray(values, dtype=float)
    if values.shape[1:] != (3,):
        raise InputError(f"'{name}' have shape {values.shape}; expected 3 components")
    length = np.linalg.norm(values, axis=1, keepdims=True)
    wrong = np.flatnonzero(~(np.abs(length[:, 0] - 1.0) <= _UNIT))
    if wrong.size:
        raise InputError(
            f"'{name}' at {where} {wrong[0]} has length {length[wrong[0], 0]:.4g}, "
            f"{wrong.size} such of {len(values)}; expected unit vectors"
        )
    return values / length


def _own_node_sets(mesh: Mesh) -> Sets:
    """Return the node sets that do not follow from the facet set of their name."""
    return {
        name: nodes
        for name, nodes in mesh.node_sets.items()
        if not np.array_equal(np.unique(nodes), np.unique(mesh.facet_sets.get(name, ())))
    }


def _with_tags(mesh: Mesh, node_sets: Sets) -> meshio.Mesh:
    """Return the sets as gmsh's physical groups; a facet or node in two sets is written twice."""
    solid, triangle = _CELLS[mesh.order]
    groups = [(2, triangle, name, rows) for name, rows in mesh.facet_sets.items()]
    groups += [(0, "vertex", name, nodes[:, None]) for name, nodes in node_sets.items()]
    blocks = [(solid, mesh.elements), *((kind, rows) for _, kind, _, rows in groups)]
    tags = [np.full(len(rows), tag) for tag, (_, rows) in enumerate(blocks)]
    names = {name: np.array([k, dim]) for k, (dim, _, name, _) in enumerate(groups, start=1)}
    data = {TAG: tags, "gmsh:geometrical": [tag + 1 for tag in tags]}
    return meshio.Mesh(mesh.nodes, blocks, cell_data=data, field_data=names)


def _with_marks(mesh: Mesh, node_sets: Sets, directions: Sets) -> meshio.Mesh:
    """Return the sets as data of 0 and 1 on triangles and points."""

    def mark(members: np.ndarray, count: int) -> np.ndarray:
        return np.isin(np.arange(count), members).astype(np.int32)

    solid, triangle = _CELLS[mesh.order]
    blocks = [(solid, mesh.elements)]
    data = {name: [values] for name, values in directions.items()}
    if mesh.facet_sets:
        rows = np.unique(np.concatenate([*mesh.facet_sets.values()]), axis=0)
        blocks.append((triangle, rows))
        for values in data.values():
            values.append(np.zeros((len(rows), *values[0].shape[1:]), values[0].dtype))
        none = np.zeros(len(mesh.elements), np.int32)
        for name, facets in mesh.facet_sets.items():
            data[MARK + name] = [none, mark(find_rows(facets, rows), len(rows))]
    points = {MARK + name: mark(nodes, len(mesh.nodes)) for name, nodes in node_sets.items()}
    return meshio.Mesh(mesh.nodes, blocks, cell_data=data, point_data=points)
