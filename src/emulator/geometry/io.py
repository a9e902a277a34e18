"""Meshes in and out of files with their named sets, deformed bodies out to VTU, through meshio."""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from emulator.core.errors import InputError
from emulator.core.store import replacing
from emulator.geometry.discretisation import quadrature_points
from emulator.geometry.fibres import across, from_elements, from_nodes
from emulator.geometry.foreign import MARK, as_meshio, own_node_sets, read_sets
from emulator.geometry.mesh import Mesh, coincident, orient
from emulator.geometry.refinement import to_quadratic

# meshio's cells by the elements' order: (tetrahedron, triangle).
_CELLS = {1: ("tetra", "triangle"), 2: ("tetra10", "triangle6")}
_LOWER = {"triangle", "triangle6", "line", "line3", "vertex"}
# A direction whose length differs from 1 by more is refused; single precision stays far below.
_UNIT = 1e-3
# Fibres and sheets that were interpolated are made orthogonal again, if the cosine between them is
# below this at nine points in ten: at a jump, as between two walls, it may be anything.
_SKEW = 0.2


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh with fibres and sheets at its elements' quadrature points.

    Both are (m, 3) on a linear mesh and (m, q, 3) on a quadratic one; ``None`` where the file has
    none.
    """

    mesh: Mesh
    fibres: np.ndarray | None = None
    sheets: np.ndarray | None = None


def read_mesh(source: str | Path | Any) -> Mesh:
    """Return tetrahedra and named sets from any file meshio reads, lengths taken as mm.

    Or from a mesh of scikit-fem, PyVista or meshio (:mod:`emulator.geometry.foreign`).

    Groups of triangles become facet sets and node sets, groups of lines and points node sets.
    Nodes of no tetrahedron are dropped and inverted tetrahedra are turned.

    Raises
    ------
    InputError
        Missing or unreadable file, cells other than tetrahedra, a group without a name, a group
        off the surface, or a mesh :class:`Mesh` refuses.
    """
    return _convert(source, directions=False).mesh


def read_body(source: str | Path | Any, *, quadratic: bool = False) -> Body:
    """Return the mesh as :func:`read_mesh` returns it, with its ``fibres`` and ``sheets``.

    Both are data of points, or of cells: (m, 3), or (m, 3 q) for all quadrature points. Point and
    cell data are interpolated at the quadrature points (:mod:`emulator.geometry.fibres`); cell
    data of linear elements is taken as it is.

    Parameters
    ----------
    quadratic : make a linear mesh quadratic, its edges straight.

    Raises
    ------
    InputError
        As :func:`read_mesh`, or a direction that is not a unit vector.
    """
    return _convert(source, directions=True, quadratic=quadratic)


def read_regions(path: str | Path, name: str) -> np.ndarray:
    """Return the whole number (m,) of each element from cell data ``name``."""
    content = read_cells(Path(path))
    if name not in content.cell_data:
        names = ", ".join(f"'{key}'" for key in content.cell_data) or "none"
        raise InputError(f"mesh file {path}: it has no cell data '{name}' for regions; has {names}")
    kind = _tetrahedra(content)
    blocks = zip(content.cells, content.cell_data[name], strict=True)
    values = np.concatenate([data for block, data in blocks if block.type == kind])
    if values.ndim != 1 or not (values == np.round(values)).all():
        raise InputError(f"mesh file {path}: '{name}' are not one whole number for each element")
    return values.astype(np.int64)


def write_mesh(
    path: str | Path,
    mesh: Mesh,
    fibres: np.ndarray | None = None,
    sheets: np.ndarray | None = None,
) -> None:
    """Write mesh, named sets and directions, to be read back by :func:`read_body`.

    Parameters
    ----------
    path : ends in .vtu, .xdmf or .msh (gmsh 2.2, sets as physical groups).
    mesh : in mm.
    fibres, sheets : unit directions (m, 3) or (m, q, 3), the latter written as 3 q components; not
        in .msh, where meshio cannot read them.

    Raises
    ------
    InputError
        Another suffix, or data the format cannot hold: for .msh, directions, or different nodes in
        a node set and a facet set of one name; for .xdmf, facet sets of a quadratic mesh.
    """
    directions = {
        name: np.asarray(values).reshape(len(mesh.elements), -1)
        for name, values in (("fibres", fibres), ("sheets", sheets))
        if values is not None
    }
    _check_format(path, mesh, directions)
    suffix = Path(path).suffix
    with replacing(path) as temporary:
        if suffix == ".msh":
            content = _with_tags(mesh)
            meshio.write(temporary, content, file_format="gmsh22", binary=True)
        else:
            # By default XDMF writes its arrays to a second file, named after the temporary one.
            options = {"data_format": "XML"} if suffix == ".xdmf" else {}
            content = _with_marks(mesh, directions)
            meshio.write(temporary, content, file_format=suffix[1:], **options)


def write_nodal(path: str | Path, mesh: Mesh, fields: Mapping[str, np.ndarray]) -> None:
    """Write values at the nodes, (n,) by name, as VTU."""
    _write_vtu(path, mesh, point_data=dict(fields))


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
        array = np.asarray(values)
        cells[name] = [array.reshape(len(array), -1) if array.ndim == 3 else array]
    _write_vtu(path, mesh, point_data={"displacement": np.asarray(displacement)}, cell_data=cells)


def _write_vtu(path: str | Path, mesh: Mesh, **data: Any) -> None:
    output = meshio.Mesh(mesh.nodes, [(_CELLS[mesh.order][0], mesh.elements)], **data)
    with replacing(path) as temporary:
        meshio.write(temporary, output, file_format="vtu")


def read_cells(path: Path) -> meshio.Mesh:
    """Return the content of a file as meshio reads it; :class:`InputError` where it cannot."""
    if not path.is_file():
        what = "is a folder; name a file in it" if path.is_dir() else "does not exist"
        raise InputError(f"mesh file {path} {what}")
    if not path.stat().st_size:
        raise InputError(f"mesh file {path} is empty")
    output = io.StringIO()
    try:
        # meshio's readers raise exceptions of many types, or print a reason and exit.
        # In a text file of STL it takes letters for a number of triangles, which overflows.
        with redirect_stdout(output), redirect_stderr(output), np.errstate(over="ignore"):
            return meshio.read(path)
    except (Exception, SystemExit) as error:
        reason = output.getvalue() if isinstance(error, SystemExit) else str(error)
        reason = " ".join(reason.split())[:160] or type(error).__name__
        raise InputError(f"mesh file {path} cannot be read as a mesh: {reason}") from error


def _convert(source: str | Path | Any, *, directions: bool, quadratic: bool = False) -> Body:
    is_file = isinstance(source, str | Path)
    content = read_cells(Path(source)) if is_file else as_meshio(source)
    try:
        mesh, numbers = _mesh(content)
        if not directions:
            return Body(mesh)
        order = 2 if quadratic else mesh.order
        fibres, sheets = (
            _directions(content, mesh, numbers, name, order) for name in ("fibres", "sheets")
        )
        if fibres is not None and sheets is not None and fibres.ndim == 3:
            # Interpolation does not preserve orthogonality.
            skew = np.quantile(np.abs(np.sum(fibres * sheets, axis=-1)), 0.9)
            sheets = across(sheets, fibres) if skew < _SKEW else sheets
        return Body(mesh if order == mesh.order else to_quadratic(mesh), fibres, sheets)
    except InputError as error:
        name = f"mesh file {source}" if is_file else f"mesh ({type(source).__name__})"
        raise InputError(f"{name}: {str(error).removeprefix('mesh: ')}") from error


def _mesh(content: meshio.Mesh) -> tuple[Mesh, np.ndarray]:
    """Return the mesh, and the file's number (n,) of each of its nodes."""
    kind = _tetrahedra(content)
    elements = np.concatenate([block.data for block in content.cells if block.type == kind])
    numbers, points = np.unique(elements), np.asarray(content.points, dtype=float)
    if numbers[0] < 0 or numbers[-1] >= len(points):
        return Mesh(points, elements), numbers  # raises InputError and names the range
    number = np.full(len(points), -1)
    number[numbers] = np.arange(len(numbers))
    nodes = points[numbers]
    elements = orient(nodes, number[elements])
    mesh = Mesh(nodes, elements, *read_sets(content, number, elements))
    pairs = coincident(nodes)
    if len(pairs):
        one, other = np.sort(numbers[pairs[0]])
        raise InputError(
            f"its nodes {one} and {other} are at the same place, {len(pairs)} such pairs, so that "
            "what touches there is not joined; merge them"
        )
    return mesh, numbers


def _tetrahedra(content: meshio.Mesh) -> str:
    """Return the one type of tetrahedra in the file; :class:`InputError` names any other cells."""
    kinds = sorted({block.type for block in content.cells if len(block.data)})
    solid = [kind for kind in kinds if kind in ("tetra", "tetra10")]
    other = [kind for kind in kinds if kind not in _LOWER | {"tetra", "tetra10"}]
    if other:
        raise InputError(
            f"it has {', '.join(other)} cells; expected tetrahedra only (tetra or tetra10): "
            "mesh or split the volume into them"
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
    kind = _CELLS[mesh.order][0]
    if name in content.cell_data:
        blocks = zip(content.cells, content.cell_data[name], strict=True)
        values = np.concatenate([data for block, data in blocks if block.type == kind])
        points = len(quadrature_points(order))
        if points > 1 and values.ndim == 2 and values.shape[1] == 3 * points:
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
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"'{name}' have shape {values.shape}; expected 3 components")
    length = np.linalg.norm(values, axis=1, keepdims=True)
    wrong = np.flatnonzero(~(np.abs(length[:, 0] - 1.0) <= _UNIT))
    if wrong.size:
        raise InputError(
            f"'{name}' at {where} {wrong[0]} has length {length[wrong[0], 0]:.4g}, "
            f"{wrong.size} such of {len(values)}; expected unit vectors"
        )
    return values / length


def _check_format(path: str | Path, mesh: Mesh, directions: Mapping[str, np.ndarray]) -> None:
    """Refuse data that the format cannot hold or meshio cannot read back."""
    suffix = Path(path).suffix
    if suffix not in (".msh", ".vtu", ".xdmf"):
        raise InputError(f"mesh file {path}: cannot write '{suffix}'; use .msh, .vtu or .xdmf")
    if suffix == ".xdmf" and mesh.order == 2 and mesh.facet_sets:
        raise InputError(f"mesh file {path}: .xdmf cannot hold quadratic facet sets; use .vtu")
    if suffix != ".msh":
        return
    if directions:
        raise InputError(f"mesh file {path}: .msh cannot hold {', '.join(directions)}; use .vtu")
    for name in own_node_sets(mesh):
        if name in mesh.facet_sets:
            raise InputError(
                f"mesh file {path}: facet set '{name}' and node set '{name}' have different nodes; "
                "give them different names or use .vtu"
            )


def _with_tags(mesh: Mesh) -> meshio.Mesh:
    """Return the sets as gmsh's physical groups; a facet or node in two sets is written twice."""
    solid, triangle = _CELLS[mesh.order]
    groups = [(2, triangle, name, rows) for name, rows in mesh.facet_sets.items()]
    groups += [(0, "vertex", name, n[:, None]) for name, n in own_node_sets(mesh).items()]
    blocks = [(solid, mesh.elements), *((kind, rows) for _, kind, _, rows in groups)]
    tags = [np.full(len(rows), tag) for tag, (_, rows) in enumerate(blocks)]
    return meshio.Mesh(
        mesh.nodes,
        blocks,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": [tag + 1 for tag in tags]},
        field_data={
            name: np.array([tag, dimension])
            for tag, (dimension, _, name, _) in enumerate(groups, start=1)
        },
    )


def _with_marks(mesh: Mesh, directions: Mapping[str, np.ndarray]) -> meshio.Mesh:
    """Return the sets as data of 0 and 1 on triangles and points."""
    solid, triangle = _CELLS[mesh.order]
    blocks = [(solid, mesh.elements)]
    marks: dict[str, np.ndarray] = {}
    if mesh.facet_sets:
        sets = list(mesh.facet_sets.values())
        rows, positions = np.unique(np.concatenate(sets), axis=0, return_inverse=True)
        blocks.append((triangle, rows))
        ends = np.cumsum([len(facets) for facets in sets])[:-1]
        for name, members in zip(mesh.facet_sets, np.split(positions, ends), strict=True):
            marks[MARK + name] = np.isin(np.arange(len(rows)), members).astype(np.int32)
    data = {name: _pad_cells(values, blocks) for name, values in directions.items()}
    none = np.zeros(len(mesh.elements), np.int32)
    data |= {name: [none, values] for name, values in marks.items()}
    points = {
        MARK + name: np.isin(np.arange(len(mesh.nodes)), nodes).astype(np.int32)
        for name, nodes in own_node_sets(mesh).items()
    }
    return meshio.Mesh(mesh.nodes, blocks, cell_data=data, point_data=points)


def _pad_cells(values: np.ndarray, blocks: list[tuple[str, np.ndarray]]) -> list[np.ndarray]:
    """Return the cell data of every block: ``values`` (m, k) on the tetrahedra, zeros elsewhere."""
    return [values, *(np.zeros((len(rows), values.shape[1])) for _, rows in blocks[1:])]
