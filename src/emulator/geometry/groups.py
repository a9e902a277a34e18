"""Sets of nodes and facets from the groups of a mesh file, and what else the file has.

Gmsh, Abaqus and others store names of groups differently: meshio returns them as ``field_data``
with tags, ``cell_sets`` or ``point_sets``. In formats without named sets (VTU, XDMF) a set is an
array of 0 and 1 called ``set:<name>``, on triangles or on points, or all sets are one array of
whole numbers on triangles, by which they are then called.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import meshio
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import boundary_facets, find_rows

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
    """Return the cell data that numbers groups, and names of groups by their number, if it has any.

    It is Gmsh's, or the first that numbers triangles. MED has names, and meshio writes its sets as
    one array from -1, for none, called by all names.
    """
    if TAG in content.cell_data and any(np.any(each) for each in content.cell_data[TAG]):
        return TAG, {}
    faces = np.concatenate([np.full(len(each.data), each.dim == 2) for each in content.cells])
    for name, data in content.cell_data.items():
        numbers = np.concatenate([np.ravel(each) for each in data])
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
