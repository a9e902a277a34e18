"""Scenes from TOML files, lengths in mm and stresses in kPa (``docs/scene_files.md``)."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.line_index import toml_lines
from emulator.geometry.io import Body, read_body, read_mesh, read_regions
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.geometry.side_by_side import Bodies, check_name, shifted, side_by_side
from emulator.mechanics.laws import Law, find_law
from emulator.scenes.checks import directions_read
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene

if TYPE_CHECKING:  # pydantic is imported when a scene file is read, not with the package
    from emulator.core.schema import Source
    from emulator.scenes.file_schema import Plane, SceneFile

Regions = np.ndarray | None

_AXES = {"x": 0, "y": 1, "z": 2}
# A node this far from a plane, as a fraction of the body's size, is on it.
_ON_PLANE = 1e-8
_BODY = "body"  # the name of the regions where each body is one


def read_scene(path: str | Path) -> Scene:
    """Return the scene that a TOML file describes; the path of the mesh is relative to the file.

    Raises
    ------
    InputError
        One line naming the file, its line and key, what was found and what would be right.
    """
    from emulator.core.schema import Source, parse
    from emulator.scenes.file_schema import SceneFile

    path = Path(path)
    if not path.is_file():
        raise InputError(f"scene file {path} does not exist")
    try:
        text = path.read_text(encoding="utf-8")
        entries = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"scene file {path} is not valid TOML: {error}") from error
    source = Source(f"scene file {path}", entries, toml_lines(text))
    return _scene(path, parse(SceneFile, source), source)


def _scene(path: Path, file: SceneFile, source: Source) -> Scene:
    with source.at("law"):
        law = find_law(file.law)
    body, regions = (_several_bodies if file.bodies else _one_body)(path.parent, file, law, source)
    mesh, fibres, sheets = _with_planes(body.mesh, file, source), body.fibres, body.sheets
    if file.fibres is not None:
        with source.at("fibres", table=("fibres",)):
            fibres, sheets = file.fibres.directions(mesh)
    parameters = _parameters(file, source)
    _check_sets(mesh, source)
    try:
        return Scene(
            name=path.stem,
            mesh=mesh,
            law=law,
            origin={"scene": "file", "path": str(path.resolve())},
            fibres=fibres,
            fibre_rule=file.fibres,
            angles=file.fibres.angles_in(mesh) if file.fibres is not None else (),
            sheets=sheets if law.sheets else None,
            regions=regions,
            parameters=parameters,
            loads=file.loads,
            supports=file.supports,
            constants=file.constants,
            dilatation=file.dilatation,
            loaded_by=file.loaded_by,
        )
    except InputError as error:
        raise source.error(str(error), _quantity_in(str(error), file)) from error


def _one_body(folder: Path, file: SceneFile, law: Law, source: Source) -> tuple[Body, Regions]:
    """Return the body of ``mesh``, and its regions."""
    if file.mesh is None:
        raise source.error("key 'mesh' is missing; give a mesh file, or tables [[bodies]]")
    path = folder / file.mesh
    with source.at("mesh"):
        body = _read_body(path, file, law)
    _check_order(path, body.mesh, file, source)
    with source.at("regions"):
        return body, None if file.regions is None else read_regions(path, file.regions)


def _several_bodies(
    folder: Path, file: SceneFile, law: Law, source: Source
) -> tuple[Body, Regions]:
    """Return the bodies of ``[[bodies]]`` as one, and their regions."""
    if file.mesh is not None:
        raise source.error("there are tables [[bodies]], too; give either", ("mesh",))
    members: dict[str, Body] = {}
    regions: dict[str, np.ndarray] = {}
    for k, entry in enumerate(file.bodies):
        path = folder / entry.mesh
        with source.at("bodies", k, "name", table=("bodies", k)):
            check_name(entry.name)
            if entry.name in members:
                raise InputError(f"there is a body '{entry.name}' before; give each a name")
        with source.at("bodies", k, "mesh", table=("bodies", k)):
            body = _read_body(path, file, law)
            members[entry.name] = replace(body, mesh=shifted(body.mesh, entry.shift))
        _check_order(path, body.mesh, file, source)
        with source.at("regions"):
            if file.regions == _BODY:
                regions[entry.name] = np.full(len(body.mesh.elements), k + 1)
            elif file.regions is not None:
                regions[entry.name] = read_regions(path, file.regions)
    with source.at("bodies"):
        bodies = side_by_side({name: body.mesh for name, body in members.items()})
        fibres, sheets = (_stack_directions(bodies, members, kind) for kind in ("fibres", "sheets"))
    return Body(bodies.mesh, fibres, sheets), bodies.stacked(regions) if regions else None


def _stack_directions(bodies: Bodies, members: Mapping[str, Body], kind: str) -> np.ndarray | None:
    """Return the directions of all bodies; none where one of them has none."""
    values = {name: getattr(body, kind) for name, body in members.items()}
    return None if any(v is None for v in values.values()) else bodies.stacked(values)


def _check_order(path: Path, mesh: Mesh, file: SceneFile, source: Source) -> None:
    if file.order is not None and file.order < mesh.order:
        problem = f"order = 1; mesh file {path.name} has quadratic tetrahedra, expected 2"
        raise source.error(problem, ("order",))


def _read_body(mesh_path: Path, file: SceneFile, law: Law) -> Body:
    """Return a mesh file's body, with directions that law and loads need and no rule gives."""
    readers = directions_read(law, file.loads)
    if readers["fibres"] is None or file.fibres is not None:
        mesh = read_mesh(mesh_path)
        return Body(to_quadratic(mesh) if file.order == 2 and mesh.order == 1 else mesh)
    body = read_body(mesh_path, quadratic=file.order == 2)
    for kind, directions in (("fibres", body.fibres), ("sheets", body.sheets)):
        if readers[kind] is not None and directions is None:
            raise InputError(
                f"{readers[kind]} needs {kind}, and mesh file {mesh_path.name} has none; give it "
                f"cell or point data '{kind}' of 3 components, or this file a table [fibres]"
            )
    return body


def _with_planes(mesh: Mesh, file: SceneFile, source: Source) -> Mesh:
    """Return the mesh with the sets that the file defines by planes."""
    node_sets, facet_sets = dict(mesh.node_sets), dict(mesh.facet_sets)
    for name, plane in file.node_sets.items():
        with source.at("node_sets", name, "at", table=("node_sets", name)):
            node_sets[name] = np.flatnonzero(_on_plane(mesh, node_sets, plane, "node"))
    for name, plane in file.facet_sets.items():
        with source.at("facet_sets", name, "at", table=("facet_sets", name)):
            on_plane = _on_plane(mesh, node_sets, plane, "surface triangle")
            facet_sets[name] = mesh.surface[on_plane[mesh.surface].all(axis=1)]
    return replace(mesh, node_sets=node_sets, facet_sets=facet_sets)


def _on_plane(
    mesh: Mesh, node_sets: Mapping[str, np.ndarray], plane: Plane, member: str
) -> np.ndarray:
    """Return whether each node (n,) lies on the plane; refuse a plane without any ``member``.

    member : what the plane must contain, "node" or "surface triangle".
    """
    coordinate = mesh.nodes[:, _AXES[plane.axis]]
    on_plane = np.abs(coordinate - plane.at) <= _ON_PLANE * mesh.size
    if plane.within is not None:
        parent = look_up(node_sets, plane.within, "node set")
        on_plane &= np.isin(np.arange(len(mesh.nodes)), parent)
    hits = on_plane if member == "node" else on_plane[mesh.surface].all(axis=1)
    if not hits.any():
        low, high = coordinate.min(), coordinate.max()
        inside = f" in '{plane.within}'" if plane.within else ""
        raise InputError(
            f"no {member} at {plane.axis} = {plane.at:g} mm{inside}; the body is between {low:g} "
            f"and {high:g}"
        )
    return on_plane


def _parameters(file: SceneFile, source: Source) -> tuple[Parameter, ...]:
    parameters = []
    for name, entry in file.parameters.items():
        with source.at("parameters", name):
            parameters.append(Parameter(name, entry.unit, *entry.range, entry.scale))
    return tuple(parameters)


def _check_sets(mesh: Mesh, source: Source) -> None:
    """Refuse loads and supports on sets that the mesh does not have, by the line of the set."""
    for array in ("supports", "loads"):
        for k, entries in enumerate(source.data.get(array, ())):
            for key, find in (("node_set", mesh.node_set), ("facet_set", mesh.facet_set)):
                with source.at(array, k, key, table=(array, k)):
                    if key in entries:
                        find(entries[key])


def _quantity_in(message: str, file: SceneFile) -> tuple[str, ...]:
    """Return the path of the first parameter or constant that a message quotes, or ()."""
    for name in re.findall(r"'([^']+)'", message):
        for table in ("parameters", "constants"):
            if name in getattr(file, table):
                return table, name
    return ()
