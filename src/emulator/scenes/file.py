"""Scenes from TOML files, lengths in mm and stresses in kPa (``docs/scene_files.md``)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.rooms import offered
from emulator.geometry.io import Body, read_body, read_mesh, read_modes, read_regions
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.geometry.side_by_side import check_name, shifted, side_by_side
from emulator.mechanics.laws import Law, find_law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.forward_problem import ForwardProblem, directions_read
from emulator.scenes.parameter_space import LogNormal, Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.tissue import FibreAngles

if TYPE_CHECKING:  # pydantic is imported when a scene file is read, not with the package
    from emulator.core.schema import Source
    from emulator.scenes.file_schema import ParameterTable, Plane, SceneFile

Regions = np.ndarray | None
Entries = dict[str, Any]
"""Fields of a scene or a specimen, by name."""

# A node this far from a plane, as a fraction of the body's size, is on it.
_ON_PLANE = 1e-8


def read_scene(path: str | Path) -> ForwardProblem:
    """Return what a TOML file describes; paths of a mesh and of a table are relative to the file.

    Raises
    ------
    InputError
        One line naming the file, its line and key, what was found and what would be right.
    """
    from emulator.core.schema import parse, read_toml
    from emulator.scenes.file_schema import SceneFile

    path = Path(path)
    source = read_toml(path, "scene file")
    if "solver" in source.data:
        for read_external in offered("emulator.external.file", "read_external"):
            problem: ForwardProblem = read_external(path, source, _parameter)
            return problem
        raise source.error("this needs the room 'emulator.external'", ("solver",))
    file = parse(SceneFile, source)
    with source.at("law"):
        law = find_law(file.law)
    entries: Entries = {
        "name": path.stem,
        "law": law,
        "origin": {"scene": "file", "path": str(path.resolve())},
        "constants": file.constants,
        "fibre_rule": file.fibres,
    }
    make, of_body = _kind_of(file, source)(path.parent, file, law, source)
    parameters = []
    limits = (*law.quantities, *getattr(of_body.get("viscosity"), "quantities", ()))
    for name, entry in file.parameters.items():
        with source.at("parameters", name, table=("parameters", name)):
            parameters.append(_parameter(name, entry, limits))
    if file.history is not None:
        make = _with_history(path.parent / file.history, source)
    try:
        return make(parameters=tuple(parameters), **entries, **of_body)
    except InputError as error:
        raise source.error(str(error), _quantity_in(str(error), file)) from error


def _with_history(table: Path, source: Source) -> Callable[..., ForwardProblem]:
    """Return the function that makes a body with the history in ``table``."""
    for body_in_time in offered("emulator.fem.history", "body_in_time"):
        return partial(body_in_time, table)
    raise source.error("this needs the room 'emulator.viscosity'", ("history",))


def _parameter(name: str, entry: ParameterTable, quantities: Iterable[Quantity]) -> Parameter:
    """Return the parameter of a table, which has a range, or a median and a log_sd.

    quantities : those of the law and of viscosity, which limit a median.
    """
    keys = entry.model_fields_set - {"unit"}
    if {"range", "scale"} & keys and {"median", "log_sd", "source"} & keys:
        raise InputError(
            f"it has {', '.join(sorted(keys))}; give range and scale, or median, log_sd and source"
        )
    if entry.range is not None:
        return Parameter(name, entry.unit, *entry.range, entry.scale)
    if entry.median is None or entry.log_sd is None:
        raise InputError("give a range, or median and log_sd")
    prior = LogNormal(entry.median, entry.log_sd, entry.source)
    limit = next((q for q in quantities if q.name == name), Quantity(name))
    if fault := limit.value_fault(entry.median):
        raise InputError(f"median: {fault}")
    return Parameter.log_normal(name, entry.unit, prior, limit.high)


def _kind_of(file: SceneFile, source: Source) -> Callable[..., tuple[Any, Entries]]:
    """Return the function that reads what is apart in files of scenes and of specimens."""
    if file.specimen is None:
        return _on_mesh
    for of_specimen in offered("emulator.specimens.file", "of_specimen"):
        return of_specimen
    raise source.error("this needs the room 'emulator.specimens'", ("specimen",))


def _on_mesh(
    folder: Path, file: SceneFile, law: Law, source: Source
) -> tuple[type[Scene], Entries]:
    """Return the fields of a scene that its body, its loads and its supports give."""
    if not file.supports:
        raise source.error("key 'supports' is missing; expected tables [[supports]]")
    for table in ("grips", "tube"):
        if table in source.data:
            problem = f"only a specimen has {table}; give its table as 'specimen'"
            raise source.error(problem, (table,))
    read = _several_bodies if file.bodies else _one_body
    body, regions = read(folder, file, law, source)
    with source.at("stiffness_modes"):
        modes = _modes(folder, file)
    mesh, fibres, sheets = _with_planes(body.mesh, file, source), body.fibres, body.sheets
    angles: tuple[FibreAngles, ...] = ()
    if file.fibres is not None:
        with source.at("fibres", table=("fibres",)):
            fibres, sheets = file.fibres.directions(mesh)
            angles = file.fibres.angles_in(mesh)
    _check_sets(mesh, source)
    return Scene, {
        "mesh": mesh,
        "fibres": fibres,
        "sheets": sheets if law.sheets else None,
        "angles": angles,
        "regions": regions,
        "stiffness_modes": modes,
        "loads": file.loads,
        "supports": file.supports,
        "dilatation": file.dilatation,
        "loaded_by": file.loaded_by,
        "viscosity": _viscosity(file, source),
        "inertia": None if file.inertia is None else file.inertia.model_dump(),
    }


def _viscosity(file: SceneFile, source: Source) -> Any:
    """Return the viscosity of a body, or None."""
    with source.at("viscosity", table=("viscosity",)):
        if file.viscosity is None:
            return None
        for viscosity_of in offered("emulator.viscosity.series", "viscosity_of"):
            return viscosity_of(file.viscosity.model_dump())
        raise InputError("this needs the room 'emulator.viscosity'")


def _one_body(folder: Path, file: SceneFile, law: Law, source: Source) -> tuple[Body, Regions]:
    """Return the body of ``mesh``, and its regions."""
    if file.mesh is None:
        raise source.error("key 'mesh' is missing; give a mesh file, or tables [[bodies]]")
    body = _read_body(folder / file.mesh, file, law, source, "mesh")
    with source.at("regions"):
        regions = None if file.regions is None else read_regions(folder / file.mesh, file.regions)
    return body, regions


def _modes(folder: Path, file: SceneFile) -> np.ndarray | None:
    """Return the modes of stiffness of a scene's mesh."""
    if file.stiffness_modes is None:
        return None
    if file.mesh is None:
        raise InputError("only a scene of one mesh has modes of stiffness; give its 'mesh'")
    return read_modes(folder / file.mesh, file.stiffness_modes)


def _several_bodies(
    folder: Path, file: SceneFile, law: Law, source: Source
) -> tuple[Body, Regions]:
    """Return the bodies of ``[[bodies]]`` as one, and their regions."""
    if file.mesh is not None:
        raise source.error("there are tables [[bodies]], too; give either", ("mesh",))
    members: dict[str, Body] = {}
    regions: dict[str, np.ndarray] = {}
    for k, entry in enumerate(file.bodies):
        with source.at("bodies", k, "name", table=("bodies", k)):
            check_name(entry.name)
            if entry.name in members:
                raise InputError(f"there is a body '{entry.name}' before; give each a name")
        body = _read_body(folder / entry.mesh, file, law, source, "bodies", k, "mesh")
        members[entry.name] = replace(body, mesh=shifted(body.mesh, entry.shift))
        with source.at("regions"):
            if file.regions == "body":  # each body is a region
                regions[entry.name] = np.full(len(body.mesh.elements), k + 1)
            elif file.regions is not None:
                regions[entry.name] = read_regions(folder / entry.mesh, file.regions)
    with source.at("bodies"):
        bodies = side_by_side({name: body.mesh for name, body in members.items()})
        stacked: list[np.ndarray | None] = []
        for kind in ("fibres", "sheets"):
            values = {name: getattr(body, kind) for name, body in members.items()}
            some_lack = any(v is None for v in values.values())
            stacked.append(None if some_lack else bodies.stacked(values))
    return Body(bodies.mesh, stacked[0], stacked[1]), bodies.stacked(regions) if regions else None


def _read_body(path: Path, file: SceneFile, law: Law, source: Source, *entry: str | int) -> Body:
    """Return the body of the mesh file that ``entry`` names.

    It has the directions that law and loads need and no rule gives.
    """
    readers = directions_read(law, file.loads)
    with source.at(*entry, table=entry[:-1]):
        if readers["fibres"] is None or file.fibres is not None:
            mesh = read_mesh(path)
            body = Body(to_quadratic(mesh) if file.order == 2 and mesh.order == 1 else mesh)
        else:
            body = read_body(path, quadratic=file.order == 2)
            for kind, directions in (("fibres", body.fibres), ("sheets", body.sheets)):
                if readers[kind] is not None and directions is None:
                    raise InputError(
                        f"{readers[kind]} needs {kind}, and mesh file {path.name} has none; give "
                        f"it cell or point data '{kind}' of 3 components, or this file a table "
                        "[fibres]"
                    )
    if file.order is not None and file.order < body.mesh.order:
        problem = f"order = 1; mesh file {path.name} has quadratic tetrahedra, expected 2"
        raise source.error(problem, ("order",))
    return body


def _with_planes(mesh: Mesh, file: SceneFile, source: Source) -> Mesh:
    """Return the mesh with the sets that the file defines by planes."""
    node_sets, facet_sets = dict(mesh.node_sets), dict(mesh.facet_sets)
    for name, plane in file.node_sets.items():
        with source.at("node_sets", name, "at", table=("node_sets", name)):
            rows = np.arange(len(mesh.nodes))[:, None]
            node_sets[name] = np.flatnonzero(_on_plane(mesh, node_sets, plane, "node", rows))
    for name, plane in file.facet_sets.items():
        with source.at("facet_sets", name, "at", table=("facet_sets", name)):
            rows = mesh.surface
            facet_sets[name] = rows[_on_plane(mesh, node_sets, plane, "surface triangle", rows)]
    return replace(mesh, node_sets=node_sets, facet_sets=facet_sets)


def _on_plane(
    mesh: Mesh, node_sets: Mapping[str, np.ndarray], plane: Plane, member: str, rows: np.ndarray
) -> np.ndarray:
    """Return whether all nodes of ``rows`` (k, a) lie on the plane, (k,); refuse one of none.

    member : what a row is, "node" or "surface triangle".
    """
    coordinate = mesh.nodes[:, "xyz".index(plane.axis)]
    first, last = plane.at if isinstance(plane.at, tuple) else (plane.at, plane.at)
    off = np.maximum(first - coordinate, coordinate - last)
    on_plane = off <= _ON_PLANE * mesh.size
    if plane.within is not None:
        parent = look_up(node_sets, plane.within, "node set")
        on_plane &= np.isin(np.arange(len(mesh.nodes)), parent)
    hits = on_plane[rows].all(axis=1)
    if not hits.any():
        low, high = coordinate.min(), coordinate.max()
        inside = f" in '{plane.within}'" if plane.within else ""
        at = f"{first:g}" if first == last else f"{first:g} to {last:g}"
        raise InputError(
            f"no {member} at {plane.axis} = {at} mm{inside}; the body is between {low:g} "
            f"and {high:g}"
        )
    return hits


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
