"""The body of a scene file, or its several bodies, with directions and regions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.io import Body, read_body, read_mesh, read_regions
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_quadratic
from emulator.geometry.side_by_side import Bodies, check_name, shifted, side_by_side
from emulator.mechanics.laws import Law
from emulator.scenes.owners import directions_read

if TYPE_CHECKING:  # pydantic is imported when a scene file is read, not with the package
    from emulator.core.schema import Source
    from emulator.scenes.file_models import SceneFile

Regions = np.ndarray | None

BODY = "body"
"""Regions that are the bodies, where there are several."""


def one_body(folder: Path, file: SceneFile, law: Law, source: Source) -> tuple[Body, Regions]:
    """The body of ``mesh``, and its regions."""
    if file.mesh is None:
        raise source.error("key 'mesh' is missing; give a mesh file, or tables [[bodies]]")
    path = folder / file.mesh
    with source.at("mesh"):
        body = _read(path, file, law)
    _check_order(path, body.mesh, file, source)
    with source.at("regions"):
        return body, None if file.regions is None else read_regions(path, file.regions)


def several_bodies(folder: Path, file: SceneFile, law: Law, source: Source) -> tuple[Body, Regions]:
    """The bodies of ``[[bodies]]`` as one, and their regions."""
    if file.mesh is not None:
        raise source.error("there are tables [[bodies]], too; give either", ("mesh",))
    found: dict[str, Body] = {}
    regions: dict[str, np.ndarray] = {}
    for k, entry in enumerate(file.bodies):
        path = folder / entry.mesh
        with source.at("bodies", k, "name", table=("bodies", k)):
            check_name(entry.name)
            if entry.name in found:
                raise InputError(f"there is a body '{entry.name}' before; give each a name")
        with source.at("bodies", k, "mesh", table=("bodies", k)):
            body = _read(path, file, law)
            found[entry.name] = replace(body, mesh=shifted(body.mesh, entry.shift))
        _check_order(path, body.mesh, file, source)
        with source.at("regions"):
            if file.regions == BODY:
                regions[entry.name] = np.full(len(body.mesh.elements), k + 1)
            elif file.regions is not None:
                regions[entry.name] = read_regions(path, file.regions)
    with source.at("bodies"):
        bodies = side_by_side({name: body.mesh for name, body in found.items()})
        fibres, sheets = (_stacked(bodies, found, kind) for kind in ("fibres", "sheets"))
    return Body(bodies.mesh, fibres, sheets), bodies.stacked(regions) if regions else None


def _stacked(bodies: Bodies, found: Mapping[str, Body], kind: str) -> np.ndarray | None:
    """Directions of all bodies; none where one of them has none."""
    values = {name: getattr(body, kind) for name, body in found.items()}
    return None if any(v is None for v in values.values()) else bodies.stacked(values)


def _check_order(path: Path, mesh: Mesh, file: SceneFile, source: Source) -> None:
    if file.order is not None and file.order < mesh.order:
        problem = f"order = 1; mesh file {path.name} has quadratic tetrahedra, expected 2"
        raise source.error(problem, ("order",))


def _read(mesh_path: Path, file: SceneFile, law: Law) -> Body:
    """The mesh file, with the directions that law and loads need unless a rule gives them."""
    readers = directions_read(law, file.loads)
    if readers["fibres"] is None or file.fibres is not None:
        mesh = read_mesh(mesh_path)
        return Body(to_quadratic(mesh) if file.order == 2 and mesh.order == 1 else mesh)
    body = read_body(mesh_path, quadratic=file.order == 2)
    for kind, found in (("fibres", body.fibres), ("sheets", body.sheets)):
        if readers[kind] is not None and found is None:
            raise InputError(
                f"{readers[kind]} needs {kind}, and mesh file {mesh_path.name} has none; give it "
                f"cell or point data '{kind}' of 3 components, or this file a table [fibres]"
            )
    return body
