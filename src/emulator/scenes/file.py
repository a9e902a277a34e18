"""Scenes from TOML files, lengths in mm and stresses in kPa.

A block that bends under its own weight:

.. code-block:: toml

    law = "neo_hookean"
    mesh = "block.vtu"                       # any format meshio reads, beside this file

    [node_sets.left]                         # nodes on a plane; likewise [facet_sets.<name>]
    axis = "x"
    at = 0.0

    [[supports]]
    node_set = "left"                        # clamped

    [[loads]]
    kind = "gravity"
    density = 1.0                            # g/cm3
    direction = [0.0, 0.0, -1.0]

    [parameters.mu]                          # what varies
    unit = "kPa"
    range = [50.0, 100.0]
    scale = "log"                            # or "uniform", as without it

    [constants]                              # what does not
    lam = 80.0

A ventricle, whose mesh file has groups named base, endocardium and epicardium:

.. code-block:: toml

    law = "guccione"
    mesh = "ventricle.vtu"
    order = 2                                # quadratic elements, from linear ones if need be
    dilatation = "mean"                      # their way not to lock; or "pointwise"

    [fibres]                                 # without it, they come from the mesh file
    rule = "helix"
    angles = [60.0, -60.0]                   # degrees, endocardium and epicardium
    endocardium = "endocardium"              # facet sets; these are the defaults
    epicardium = "epicardium"
    axis = [0.0, 0.0, 1.0]                   # from apex to base

    [[supports]]
    node_set = "base"
    components = "z"                         # x and y stay free
    displacement = [0.0, 0.0, 0.5]           # mm

    [[supports]]
    kind = "elastic"
    facet_set = "epicardium"
    stiffness = 0.2                          # kPa/mm
    direction = "normal"                     # or "all", as without it

    [[loads]]
    kind = "follower_pressure"               # or "cavity_pressure", if its rim is held
    facet_set = "endocardium"
    pressure = 0.8                           # kPa; without it, it is a parameter

    [[loads]]
    kind = "traction"
    facet_set = "base"
    traction = [0.0, 0.1, 0.0]               # kPa, dead

    [parameters.C]
    unit = "kPa"
    range = [1.0, 4.0]

    [constants]
    b_f = 8.0
    b_t = 2.0
    b_fs = 4.0
    kappa = 50.0

Other rules for fibres are ``biventricle`` (``angles``, ``axis``; facet sets lv_endocardium,
rv_endocardium, epicardium) and ``uniform`` (``direction``). They also give the sheets, for a law
that takes any, as the transmural direction; ``uniform`` has a key ``sheets`` for them. Gravity also
takes ``acceleration`` in m/s2. A pressure that is a parameter is called ``pressure``, or what its
key ``parameter`` says.

``regions = "segment"`` names cell data of the mesh file, a whole number for each tetrahedron, such
as gmsh's own ``gmsh:physical``. In region 3 the law's energy is then multiplied by the parameter or
constant ``stiffness_3``, its resistance to volume change excepted.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from emulator.errors import InputError
from emulator.geometry.fibres import (
    Angles,
    Axis,
    biventricular_directions,
    rule_based_directions,
)
from emulator.geometry.io import Body, read_body, read_mesh, read_regions
from emulator.geometry.mesh import Mesh
from emulator.geometry.quadratic import to_quadratic
from emulator.mechanics.laws import Law, find_law
from emulator.scenes.loads import CavityPressure, FollowerPressure, Gravity, Load, Traction
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import ElasticSupport, Support
from emulator.scenes.tables import Table

Parts = tuple[Mesh, np.ndarray | None, np.ndarray | None]

_REQUIRED = ("law", "mesh", "parameters", "supports")
_OPTIONAL = (
    "constants",
    "dilatation",
    "facet_sets",
    "fibres",
    "loads",
    "node_sets",
    "order",
    "regions",
)
_AXES = {"x": 0, "y": 1, "z": 2}
# A node this far from a plane, as a fraction of the body's size, is on it.
_ON_PLANE = 1e-8
_PRESSURES: dict[str, type[CavityPressure] | type[FollowerPressure]] = {
    "cavity_pressure": CavityPressure,
    "follower_pressure": FollowerPressure,
}


def read_scene(path: str | Path) -> Scene:
    """The scene described by a TOML file; the mesh's path is relative to it.

    Raises
    ------
    InputError
        One line naming the file, the key, what was found and what would be right.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"scene file {path} does not exist")
    try:
        entries = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"scene file {path} is not valid TOML: {error}") from error
    try:
        return _scene(path, Table(entries))
    except InputError as error:
        raise InputError(f"scene file {path}: {error}") from error


def _scene(path: Path, file: Table) -> Scene:
    file.check(_REQUIRED, _OPTIONAL)
    law = find_law(file.text("law"))
    mesh_path = path.parent / file.text("mesh")
    mesh, fibres, sheets = _body(mesh_path, file, law)
    regions = read_regions(mesh_path, file.text("regions")) if "regions" in file else None
    dilatation = file.text("dilatation", "pointwise", ("pointwise", "mean"))
    parts: dict[str, Any] = {
        "fibres": fibres,
        "sheets": sheets,
        "regions": regions,
        "parameters": tuple(_parameter(*item) for item in file.tables("parameters").items()),
        "loads": tuple(map(_load, file.list("loads"))),
        "supports": tuple(map(_support, file.list("supports"))),
        "constants": file.table("constants").entries(),
        "dilatation": cast(Literal["pointwise", "mean"], dilatation),
    }
    origin = {"scene": "file", "path": str(path.resolve())}
    return Scene(name=path.stem, mesh=mesh, law=law, origin=origin, **parts)


# ---- geometry ------------------------------------------------------------------------------------
def _body(mesh_path: Path, file: Table, law: Law) -> Parts:
    """The mesh with the sets the file adds, and the directions if the law or the file wants any."""
    by_rule = "fibres" in file
    body = read_body(mesh_path) if law.fibres and not by_rule else Body(read_mesh(mesh_path))
    mesh = body.mesh
    if file.integer("order", mesh.order, (1, 2)) != mesh.order:
        if mesh.order == 2:
            raise InputError(f"order = 1; mesh file {mesh_path.name} has quadratic tetrahedra")
        mesh = to_quadratic(mesh)
    mesh = _with_planes(mesh, file)
    if by_rule:
        fibres, sheets = _by_rule(mesh, file.table("fibres"))
        return mesh, fibres, sheets if law.sheets else None
    for kind, asked, found in (
        ("fibres", law.fibres, body.fibres),
        ("sheets", law.sheets, body.sheets),
    ):
        if asked and found is None:
            raise InputError(
                f"law '{law.name}' needs {kind}, and mesh file {mesh_path.name} has none; give it "
                f"cell data '{kind}' (m, 3), or this file a table [fibres]"
            )
    return mesh, body.fibres, body.sheets if law.sheets else None


def _with_planes(mesh: Mesh, file: Table) -> Mesh:
    node_sets, facet_sets = dict(mesh.node_sets), dict(mesh.facet_sets)
    for name, table in file.tables("node_sets").items():
        node_sets[name] = np.flatnonzero(_on_plane(mesh, table, "node"))
    for name, table in file.tables("facet_sets").items():
        on_plane = _on_plane(mesh, table, "surface triangle")
        facet_sets[name] = mesh.surface[on_plane[mesh.surface].all(axis=1)]
    return replace(mesh, node_sets=node_sets, facet_sets=facet_sets)


def _on_plane(mesh: Mesh, table: Table, wanted: str) -> np.ndarray:
    """Which nodes (n,) lie on the plane; some of what is ``wanted`` must."""
    axis, at = table.text("axis", choices=_AXES), table.number("at")
    table.done()
    on_plane = np.abs(mesh.nodes[:, _AXES[axis]] - at) <= _ON_PLANE * mesh.size
    there = on_plane if wanted == "node" else on_plane[mesh.surface].all(axis=1)
    if not there.any():
        low, high = mesh.nodes[:, _AXES[axis]].min(), mesh.nodes[:, _AXES[axis]].max()
        raise InputError(
            f"{table.where}: no {wanted} at {axis} = {at:g} mm; the body is between {low:g} and "
            f"{high:g}"
        )
    return on_plane


def _by_rule(mesh: Mesh, table: Table) -> tuple[np.ndarray, np.ndarray | None]:
    """Fibres, and the sheets of those rules that have any."""
    rule = table.text("rule", choices=("helix", "biventricle", "uniform"))
    if rule == "uniform":
        fibre = _everywhere(mesh, table, "direction")
        sheet = _everywhere(mesh, table, "sheets") if "sheets" in table else None
        table.done()
        return fibre, sheet
    angles = cast(Angles, table.numbers("angles", 2))
    axis = cast(Axis, table.numbers("axis", 3, (0.0, 0.0, 1.0)))
    if rule == "biventricle":
        table.done()
        return biventricular_directions(mesh, angles, axis)
    walls = [table.text(name, name) for name in ("endocardium", "epicardium")]
    table.done()
    return rule_based_directions(mesh, walls[0], walls[1], angles, axis)


def _everywhere(mesh: Mesh, table: Table, key: str) -> np.ndarray:
    """The direction at ``key``, made unit length, for every element (m, 3)."""
    direction = np.asarray(table.numbers(key, 3))
    length = np.linalg.norm(direction)
    if not length > 0.0:
        raise InputError(f"{table.where}: {key} is zero; expected any length above 0")
    return np.tile(direction / length, (len(mesh.elements), 1))


# ---- parameters, supports, loads -----------------------------------------------------------------
def _parameter(name: str, table: Table) -> Parameter:
    unit, (low, high) = table.text("unit", ""), table.numbers("range", 2)
    scale = table.text("scale", "uniform", ("log", "uniform"))
    table.done()
    return Parameter(name, unit, low, high, cast(Literal["log", "uniform"], scale))


def _support(table: Table) -> Support | ElasticSupport:
    if table.text("kind", "held", ("held", "elastic")) == "held":
        node_set = table.text("node_set")
        displacement = np.asarray(table.numbers("displacement", 3, (0.0, 0.0, 0.0)))
        components = table.text("components", "xyz")
        table.done()
        return Support(node_set, displacement, components)
    facet_set, stiffness = table.text("facet_set"), table.number("stiffness")
    direction = table.text("direction", "all", ("all", "normal"))
    table.done()
    return ElasticSupport(facet_set, stiffness, cast(Literal["all", "normal"], direction))


def _load(table: Table) -> Load:
    kind = table.text("kind", choices=("gravity", "traction", *_PRESSURES))
    load: Load
    if kind == "gravity":
        load = Gravity(
            table.number("density", 1.0),
            cast(Axis, table.numbers("direction", 3, (0.0, 0.0, -1.0))),
            table.number("acceleration", 9.81),
        )
    elif kind == "traction":
        load = Traction(table.text("facet_set"), cast(Axis, table.numbers("traction", 3)))
    else:
        facet_set, given = table.text("facet_set"), "pressure" in table
        pressure = table.number("pressure", 0.0)
        name = table.text("parameter", "pressure")
        load = _PRESSURES[kind](facet_set, pressure if given else None, name)
    table.done()
    return load
