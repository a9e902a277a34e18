"""The content of mesh files as meshio has it, also of formats that it reads in part.

These are Gmsh's format 4 with entities that stand reversed in their group or in none, Abaqus, and
VTK's PolyData. What a file has and its content lacks is listed in ``content.info``.

**Groups.** Gmsh, Abaqus and others store names of groups differently: meshio returns them as
``field_data`` with tags, ``cell_sets`` or ``point_sets``. In formats without named sets (VTU, XDMF)
a set is an array of 0 and 1 called ``set:<name>``, on triangles or on points, or all sets are one
array of whole numbers on triangles, by which they are then called.
"""

from __future__ import annotations

import itertools
import re
import tempfile
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import meshio
import numpy as np
from meshio import _helpers
from meshio._common import num_nodes_per_cell
from meshio.abaqus import _abaqus
from meshio.gmsh import _gmsh40, _gmsh41
from meshio.vtu import _vtu

from emulator.core.errors import InputError
from emulator.geometry.mesh import boundary_facets, find_rows
from emulator.geometry.splitting import FACES

# The corners of the faces S1, S2, ... of Abaqus's elements, by their number of corners, and that
# number by the one of their nodes.
_FACES = {4: ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)), **FACES}
_CORNERS = {4: 4, 10: 4, 6: 6, 8: 8}
# Types of elements that meshio does not know.
_TYPES = {"C3D4H": "tetra", "C3D4T": "tetra", "C3D10HS": "tetra10", "M3D3": "triangle"}


def abaqus_face(word: str, nodes: int) -> tuple[int, ...]:
    """Return the places of the corners of a face such as ``S1``; none where there is no such face.

    nodes : the number of nodes of the element.
    """
    faces = _FACES.get(_CORNERS.get(nodes, 0), ())
    number = int(word[1:]) if word[:1].upper() == "S" and word[1:].isdecimal() else 0
    return faces[number - 1] if 1 <= number <= len(faces) else ()


def read_cells(path: Path, reader: Callable[[Path], meshio.Mesh] | None = None) -> meshio.Mesh:
    """Return the content of a file as meshio has it; :class:`InputError` where it cannot.

    reader : the reader of the file's format; by default meshio's.
    """
    if not path.is_file():
        what = "is a folder; name a file in it" if path.is_dir() else "does not exist"
        raise InputError(f"mesh file {path} {what}")
    if not path.stat().st_size:
        raise InputError(f"mesh file {path} is empty")
    try:
        return (reader or _reader(path))(path)
    except Exception as error:  # meshio's readers raise many types
        unknown = f"{error.args[0]} is not defined" if isinstance(error, KeyError) else ""
        reason = unknown or " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"mesh file {path} cannot be read as a mesh: {reason}") from error


def _read(path: Path) -> meshio.Mesh:
    """Read a file by the first of meshio's readers for its suffix that accepts it.

    meshio.read prints why its readers refuse a file, and exits; standard output could only be
    caught for all threads.
    """
    reasons = []
    for kind in _helpers._filetypes_from_path(path):
        try:
            # In a text file of STL it takes letters for a number of triangles, which overflows.
            with np.errstate(over="ignore"):
                return _helpers.reader_map[kind](str(path))
        except meshio.ReadError as error:
            reasons.append(f"not valid {kind}: {error}".removesuffix(": "))
    raise InputError("; ".join(reasons))


def _reader(path: Path) -> Callable[[Path], meshio.Mesh]:
    """Return the reader of the file, by its suffix and its first bytes."""
    with path.open("rb") as file:
        head = file.read(1000)
    suffix = path.suffix.lower()
    if suffix == ".msh" and head.lstrip().startswith(b"$NOD"):
        raise InputError("it has Gmsh's format 1, not 2 or 4; gmsh -save -format msh41 converts it")
    if suffix == ".feb" or b"<febio_spec" in head:
        raise InputError("it is FEBio's; FEBio Studio exports the mesh as .vtk")
    if suffix in (".pts", ".elem", ".lon"):
        name = path.with_suffix("").name
        raise InputError(
            f"it is openCARP's; meshtool convert -imsh={name} -omsh={name} -ofmt=vtk makes a .vtk"
        )
    if suffix == ".vtk" and re.search(rb"DATASET\s+POLYDATA", head):
        return _read_polydata
    readers = {".msh": _read_gmsh, ".inp": lambda path: _AbaqusPart(path).mesh(), ".vtp": _read_vtp}
    return readers.get(suffix, _read)


def _unsigned(original: Callable[..., Any], *arguments: Any) -> Any:
    """Read entities of Gmsh's format 4 by meshio, with tags without sign, and 0 for no group.

    A negative tag says that an entity is reversed in its group. meshio drops the tag of an entity
    in no group, and then assigns the remaining tags to the wrong cells.
    """
    entities = original(*arguments)
    for of_entities in entities[0] if isinstance(entities[0], tuple) else entities:
        for entity, tags in of_entities.items():
            of_entities[entity] = [abs(int(tag)) for tag in tags] or [0]
    return entities


for _module in (_gmsh40, _gmsh41):
    _module._read_entities = partial(_unsigned, _module._read_entities)


def _read_gmsh(path: Path) -> meshio.Mesh:
    """Return a Gmsh file. In format 2, ``Mesh.SaveAll = 1`` leaves only the names of groups."""
    content = _read(path)
    tags = [np.abs(numbers) for numbers in content.cell_data.get("gmsh:physical", [])]
    if tags:
        content.cell_data["gmsh:physical"] = tags
    if content.field_data and not any(numbers.any() for numbers in tags):
        names = ", ".join(content.field_data)
        content.info = [f"groups {names}, which are empty (save them with Mesh.SaveAll = 0)"]
    return content


def _read_vtp(path: Path) -> meshio.Mesh:
    """Return the polygons of VTK's PolyData in XML."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:  # raw data after the tree
        root = _vtu._parse_raw_binary(str(path))
    root.attrib |= {"type": "UnstructuredGrid", "version": "1.0"}
    for grid in root.iter("PolyData"):
        grid.tag = "UnstructuredGrid"
    for piece in root.iter("Piece"):
        piece.set("NumberOfCells", count := piece.get("NumberOfPolys", "0"))
        for child in [child for child in piece if child.tag not in ("Points", "Polys")]:
            piece.remove(child)
        for polygons in piece.iter("Polys"):
            polygons.tag = "Cells"
            kinds = {"type": "UInt8", "Name": "types", "format": "ascii"}
            ElementTree.SubElement(polygons, "DataArray", kinds).text = "7 " * int(count)
    return _polygons(ElementTree.tostring(root), ".vtu")


def _read_polydata(path: Path) -> meshio.Mesh:
    """Return the polygons of VTK's PolyData in a legacy file, which comes without its data."""
    text = re.sub(rb"DATASET\s+POLYDATA", b"DATASET UNSTRUCTURED_GRID", path.read_bytes(), count=1)
    text = re.split(rb"\n(?:POINT|CELL)_DATA\s+\d+\s*\n", text, maxsplit=1)[0]
    polygons = re.search(rb"\nPOLYGONS\s+(\d+)", text)
    if polygons is None or re.search(rb"\n(VERTICES|LINES|TRIANGLE_STRIPS)\s+\d", text):
        raise InputError("it has no polygons, or also points, lines or strips; keep the triangles")
    text = text.replace(b"\nPOLYGONS", b"\nCELLS", 1)
    count = int(polygons[1]) - text.splitlines()[0].strip().endswith(b"5.1")  # there, of offsets
    binary = text.splitlines()[2].strip().upper() == b"BINARY"
    kinds = np.full(count, 7, ">i4").tobytes() if binary else b"7 " * count
    return _polygons(text + b"\n\nCELL_TYPES %d\n" % count + kinds + b"\n", ".vtk")


def _polygons(text: bytes, suffix: str) -> meshio.Mesh:
    """Return the content of a file of polygons; polygons of three corners become triangles."""
    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / f"polygons{suffix}").write_bytes(text)
        content = _read(path)
    kinds = {3: "triangle", 4: "quad"}
    cells = [(kinds.get(block.data.shape[1], "polygon"), block.data) for block in content.cells]
    return meshio.Mesh(content.points, cells)


class _AbaqusPart:
    """The nodes, elements and sets of an Abaqus input file with one part, in words.

    Members of sets are numbers, ranges and sets; sets of solid elements become cell data, faces of
    elements become triangles. Coordinates are those of the part.
    """

    def __init__(self, path: Path) -> None:
        self.nodes: dict[str, list[str]] = {}
        self.elements: dict[str, dict[str, list[str]]] = {}  # by meshio's type
        self.sets: dict[str, dict[str, list[Any]]] = {"NSET": {}, "ELSET": {}, "FACES": {}}
        self.names: dict[str, str] = {}  # as first written: Abaqus does not mind their case
        self.unread: dict[str, None] = {}  # what was not understood, in order
        for keyword, options, rows in _sections(path):
            self._read(keyword, options, rows)

    def _read(self, keyword: str, options: dict[str, str], rows: list[list[str]]) -> None:
        """Read the rows of one section."""
        kind, name = keyword, options.get(keyword, "")
        members: list[Any] | None = [row[0] for row in rows]
        if keyword == "NODE":
            kind, name = "NSET", options.get("NSET", "")
            for number, *xyz in rows:
                if self.nodes.setdefault(number, xyz) != xyz:
                    raise InputError(f"node {number} is at two places, as of two parts; export one")
        elif keyword == "ELEMENT":
            kind, name = "ELSET", options.get("ELSET", "")
            members = self._read_elements(options.get("TYPE", "").upper(), rows)
        elif keyword == "SURFACE":
            name, of_nodes = options.get("NAME", ""), options.get("TYPE", "").upper() == "NODE"
            kind = "NSET" if of_nodes else "FACES"
            members = members if of_nodes else rows
        elif "GENERATE" in options:
            steps = [[int(word) for word in row if word] for row in rows]
            members = [str(k) for a, b, *by in steps for k in range(a, b + 1, *by)]
        else:
            members = [word for row in rows for word in row if word]
            if not members and kind in self.sets:  # such as the nodes of an element set
                self.unread[f"set {name}, which has no members of its own"] = None
        if kind in self.sets and name and members is not None:
            self.sets[kind].setdefault(name.upper(), []).extend(members)
            self.names.setdefault(name.upper(), name)

    def _read_elements(self, code: str, rows: list[list[str]]) -> list[str] | None:
        """Read elements of Abaqus' type ``code`` and return their numbers; None if unread."""
        cell = {**_abaqus.abaqus_to_meshio_type, **_TYPES}.get(code)
        if cell is None:
            self.unread[f"elements {code}"] = None
            return None
        words, width = [w for row in rows for w in row if w], 1 + num_nodes_per_cell[cell]
        if len(words) % width:
            raise InputError(f"an element {code} has not {width - 1} nodes")
        elements = np.reshape(words, (-1, width)).tolist()
        self.elements.setdefault(cell, {}).update({row[0]: row[1:] for row in elements})
        return [row[0] for row in elements]

    def numbers(self, kind: str, name: str) -> list[str]:
        """Return the numbers of a set's members, those of sets within it included."""
        of_set = []
        for word in self.sets[kind].get(name, [name]):
            member = word.rpartition(".")[2].upper()  # without the instance
            if member in self.sets[kind] and member != name:
                of_set += self.numbers(kind, member)
            elif member.isdigit():
                of_set.append(member)
            else:
                self.unread[f"'{word}' in {self.names.get(name, name)}"] = None
        return of_set

    def _faces(self, name: str, corners: dict[str, list[str]]) -> dict[str, list[str]]:
        """Return the nodes of the faces of a surface; ``corners`` has the nodes of each element."""
        faces = {}
        for which, face in ((row[0], row[-1]) for row in self.sets["FACES"][name]):
            for k in self.numbers("ELSET", which.upper()):
                places = abaqus_face(face, len(corners.get(k, ())))
                if places:
                    faces[f"{name} {k} {face}"] = [corners[k][c] for c in places]
        if not faces:
            self.unread[f"surface {self.names[name]}, which has no faces of solids"] = None
        return faces

    def mesh(self) -> meshio.Mesh:
        """Return the part as meshio's mesh, with its sets."""
        of_set = {name: self.numbers("ELSET", name) for name in self.sets["ELSET"]}
        cells = {kind: dict(rows) for kind, rows in self.elements.items()}
        corners = {k: row for rows in self.elements.values() for k, row in rows.items()}
        for name in self.sets["FACES"]:
            faces = self._faces(name, corners)
            for key, row in faces.items():
                cells.setdefault("quad" if len(row) == 4 else "triangle", {})[key] = row
            of_set[name] = [*of_set.get(name, ()), *faces]
        cells = {kind: rows for kind, rows in cells.items() if rows}
        place = {number: k for k, number in enumerate(self.nodes)}
        data = {}
        for name, members in of_set.items():
            masks = {kind: np.isin([*rows], members).astype(int) for kind, rows in cells.items()}
            flat = ("tri", "quad", "line")
            lower = any(m.any() for kind, m in masks.items() if kind.startswith(flat))
            data[f"set:{self.names[name]}" if lower else self.names[name]] = [*masks.values()]
        return meshio.Mesh(
            np.array([[float(word or 0) for word in xyz[:3]] for xyz in self.nodes.values()]),
            {
                kind: np.array([[place[k] for k in row] for row in rows.values()])
                for kind, rows in cells.items()
            },
            cell_data=data,
            point_sets={
                self.names[name]: np.array(
                    [place[k] for k in self.numbers("NSET", name) if k in place], int
                )
                for name in self.sets["NSET"]
            },
            info=[*self.unread],
        )


def _sections(path: Path) -> Iterator[tuple[str, dict[str, str], list[list[str]]]]:
    """Yield keyword, options and rows of words of each section of an Abaqus input file."""
    lines = [line.strip() for line in path.read_text("utf-8", errors="replace").splitlines()]
    lines = [line for line in lines if line and not line.startswith("**")]
    starts = [k for k, line in enumerate(lines) if line.startswith("*")]
    for start, end in itertools.pairwise([*starts, len(lines)]):
        rows = [[word.strip(' "') for word in line.split(",")] for line in lines[start:end]]
        head = rows.pop(0)
        while not head[-1] and rows:  # goes on in the next line
            head = [*head[:-1], *rows.pop(0)]
        pairs = [word.partition("=") for word in head[1:]]
        options = {key.strip().upper(): value.strip(' "') for key, _, value in pairs}
        if head[0].upper() == "*INCLUDE":
            yield from _sections(path.parent / options.get("INPUT", ""))
        yield head[0][1:].strip().upper(), options, rows


Sets = dict[str, np.ndarray]
MARK = "set:"
TAG = "gmsh:physical"
_PLURAL = {0: "points", 1: "lines", 2: "triangles"}
_OF_GMSH = ("gmsh:geometrical", "gmsh:dim_tags", "gmsh:bounding_entities")  # are no groups
_MOST = 64  # numbers in an array of groups; one with more counts the triangles
_UNMARKED = 2**31  # DOLFIN's facets without a mark have the largest number of their type


def read_sets(
    content: meshio.Mesh, number: np.ndarray, elements: np.ndarray
) -> tuple[Sets, Sets, list[str]]:
    """Return node sets and facet sets of a file's groups, and groups by number that are neither.

    number : the new number (n,) of each of the file's nodes, -1 for dropped nodes.
    elements : (m, 4 or 10) tetrahedra in the new numbers, positively oriented.
    """
    triangles: dict[str, list[np.ndarray]] = {}
    points: dict[str, list[np.ndarray]] = {}
    for name, corners in _groups(content):
        if corners.size:
            of_kind = triangles if corners.shape[1] == 3 else points
            of_kind.setdefault(name, []).append(number[corners])
    surface = boundary_facets(elements) if triangles else np.empty((0, 3), int)
    facet_sets, inner = {}, []
    for name, groups in triangles.items():
        rows = np.unique(np.sort(np.concatenate(groups), axis=1), axis=0)
        places = find_rows(rows, surface[:, :3])
        if (inside := int((places < 0).sum())) and name.lstrip("-").isdigit():
            inner.append(f"group {name} ({inside} of {len(rows)} triangles are inside)")
        elif inside:
            raise InputError(
                f"{inside} of the {len(rows)} triangles in group '{name}' are not on the "
                "surface of the tetrahedra; a group of triangles must lie on it"
            )
        else:
            facet_sets[name] = surface[places]
    node_sets = {name: np.unique(rows) for name, rows in facet_sets.items()}
    for name, groups in points.items():
        if name in facet_sets and name.isdigit():
            continue  # Gmsh numbers groups of points, lines and triangles by themselves
        nodes = np.unique(np.concatenate(groups, axis=None))
        node_sets[name] = nodes[nodes >= 0]
    return {name: nodes for name, nodes in node_sets.items() if nodes.size}, facet_sets, inner


def _groups(content: meshio.Mesh) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the corners (k, 1, 2 or 3) of every group of points, lines, triangles."""
    pairs = {name: entry for name, entry in content.field_data.items() if np.size(entry) == 2}
    names = {tuple(map(int, entry)): name for name, entry in pairs.items()}
    array, of_tag = tag_array(content)
    for k, block in enumerate(content.cells):
        if block.dim == 3:
            continue
        corners = np.asarray(block.data)[:, : block.dim + 1]
        for name, members in content.cell_sets.items():
            if name not in _OF_GMSH and members[k] is not None:
                yield name, corners[np.asarray(members[k], dtype=np.int64)]
        for name, data in content.cell_data.items():
            if name.startswith(MARK) and not name.endswith(_OF_GMSH):
                yield name.removeprefix(MARK), corners[np.flatnonzero(data[k])]
        tags = np.ravel(content.cell_data[array][k] if array else [])
        for tag in np.unique(tags[tags < _UNMARKED]).astype(int).tolist():
            if tag in (0, -1) and tag not in of_tag:
                continue
            if array == TAG and names and (tag, block.dim) not in names:
                raise InputError(
                    f"physical group {tag} ({_PLURAL[block.dim]}) has no name of its own; "
                    "name it in the mesh generator ($PhysicalNames)"
                )
            for name in of_tag.get(tag, [names.get((tag, block.dim), str(tag))]):
                yield name, corners[tags == tag]
    for name, nodes in content.point_sets.items():
        yield name, np.asarray(nodes, dtype=np.int64)[:, None]
    for name, data in content.point_data.items():
        if name.startswith(MARK):
            yield name.removeprefix(MARK), np.flatnonzero(data)[:, None]


def tag_array(content: meshio.Mesh) -> tuple[str | None, dict[int, list[str]]]:
    """Return the name of the cell data that numbers groups, and the groups' names by number.

    It is Gmsh's, or the first that numbers triangles. MED has names, and meshio writes its sets as
    one array from -1, for none, called by all names.
    """
    if TAG in content.cell_data and any(np.any(values) for values in content.cell_data[TAG]):
        return TAG, {}
    faces = np.concatenate([np.full(len(block.data), block.dim == 2) for block in content.cells])
    for name, data in content.cell_data.items():
        numbers = np.concatenate([np.ravel(values) for values in data])
        if name.startswith(MARK) or name.endswith(_OF_GMSH) or len(numbers) != len(faces):
            continue
        parts, of_faces = name.split("-"), numbers[faces]
        if faces.any() and (numbers.min(), numbers.max()) == (-1, len(parts) - 1):
            return name, {k: [part] for k, part in enumerate(parts)}
        whole = of_faces.any() and (of_faces == np.round(of_faces)).all()
        if whole and len(np.unique(of_faces)) <= min(_MOST, 0.5 * len(of_faces)):
            return name, getattr(content, "cell_tags", {})
    return None, {}


def unused(content: meshio.Mesh, kind: str, used: Collection[str | None]) -> list[str]:
    """Return a phrase for each array of data that is no set and not in ``used``."""
    phrases = [*content.info] if isinstance(content.info, list) else []
    for name in content.cell_data:
        of_cells = np.asarray(content.get_cell_data(name, kind))
        regions = of_cells.ndim == 1 and of_cells.dtype.kind in "iu" and np.ptp(of_cells) > 0
        if not (name.startswith(MARK) or name.endswith(_OF_GMSH)) and (
            regions or name not in (*used, TAG)
        ):
            phrases.append(f'{name} (regions = "{name}")' if regions else f"{name} of cells")
    others = (name for name in content.point_data if name not in used)
    return phrases + [f"{n} of points" for n in others if not n.startswith((MARK, *_OF_GMSH))]
