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
    direction = [0.0, 0.0, -1.0]             # or, as parameters, kind "gravity_vector"

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
    dilatation = "mean"                      # their way not to lock; or "pointwise";
                                             # "patch" helps linear ones (order = 1)

    [fibres]                                 # without it, they come from the mesh file
    rule = "helix"
    angles = [60.0, -60.0]    # degrees, endocardium and epicardium, or parameters' names
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
    stiffness = 0.2                          # kPa/mm; without it, it is a parameter
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

A test that is controlled by displacement: a cube of 10 mm, glued to a plate at the bottom and to
one that moves, with a weight on one edge:

.. code-block:: toml

    law = "neo_hookean"
    mesh = "cube.vtu"                        # with node sets bottom, top and front

    [[supports]]
    node_set = "bottom"

    [[supports]]
    node_set = "top"
    displacement = [10.0, 0.0, 0.0]          # mm, times the parameter
    amount = "shear"                         # that each load state has for itself

    [node_sets.edge]
    axis = "x"
    at = 10.0
    within = "front"                         # only what of that set is on the plane

    [[loads]]
    kind = "force"                           # on a point, or evenly along an edge
    node_set = "edge"
    resultant = [0.0, 0.0, -0.5]             # N; also times a parameter, with amount

    [parameters.shear]
    range = [-0.4, 0.4]

    [parameters.mu]
    unit = "kPa"
    range = [1.0, 10.0]
    scale = "log"

    [constants]
    lam = 80.0

Other rules for fibres are ``biventricle`` (``angles``, ``axis``; facet sets lv_endocardium,
rv_endocardium, epicardium) and ``uniform`` (``direction``). They also give the sheets, for a law
that takes any, as the transmural direction, turned about the fibres by ``sheet_angles`` where these
are given, as ``angles`` are; ``uniform`` has a key ``sheets`` for them. Gravity also takes
``acceleration`` in m/s2. A pressure that is a parameter is called ``pressure``, or what its key
``parameter`` says. ``published_pressure`` is the pressure work of the released code, on linear
tetrahedra only.

Muscle contracts by a load of the kind ``active_tension``, along the fibres of the file or of a
rule, whatever the law: ``tension`` in kPa, or a parameter of that name; ``transverse`` is the share
of it across the fibre.

Several bodies of one material (:mod:`emulator.geometry.side_by_side`), as two cubes of one liver:

.. code-block:: toml

    [[bodies]]                               # in place of mesh = ...
    name = "cube1"
    mesh = "cube1.vtu"                       # its set top is called cube1.top

    [[bodies]]
    name = "cube2"
    mesh = "cube2.vtu"
    shift = [20.0, 0.0, 0.0]                 # mm; no nodes of two bodies may coincide

    [node_sets."cube2.edge"]
    axis = "x"
    at = 30.0
    within = "cube2"                         # the surface of a body

``loaded_by = {pressure = "imaged"}`` says that the mesh is the body under load, as in an image: the
parameter or constant ``imaged``, in the unit of the pressure, is what ``pressure`` was then. FEM
unloads the body before it loads it; displacements are those from the mesh (docs/unloading.md).

``regions = "segment"`` names cell data of the mesh file, a whole number for each tetrahedron, such
as gmsh's own ``gmsh:physical``. In region 3 the law's energy is then multiplied by the parameter or
constant ``stiffness_3``, its resistance to volume change excepted. ``regions = "body"`` numbers
several bodies from 1.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emulator.core.errors import InputError
from emulator.core.line_index import toml_lines
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import Law, find_law
from emulator.scenes.file_bodies import one_body, several_bodies
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene

if TYPE_CHECKING:  # pydantic is imported when a scene file is read, not with the package
    from emulator.core.schema import Source
    from emulator.scenes.file_models import Plane, SceneFile

Parts = tuple[Mesh, np.ndarray | None, np.ndarray | None, np.ndarray | None]

_AXES = {"x": 0, "y": 1, "z": 2}
# A node this far from a plane, as a fraction of the body's size, is on it.
_ON_PLANE = 1e-8


def read_scene(path: str | Path) -> Scene:
    """The scene described by a TOML file; the mesh's path is relative to it.

    Raises
    ------
    InputError
        One line naming the file, its line and key, what was found and what would be right.
    """
    from emulator.core.schema import Source, parse
    from emulator.scenes.file_models import SceneFile

    path = Path(path)
    if not path.is_file():
        raise InputError(f"scene file {path} does not exist")
    try:
        text = path.read_text(encoding="utf-8")
        entries = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"scene file {path} is not valid TOML: {error}") from error
    source = Source(f"scene file {path}", entries, toml_lines(text))
    return _scene(path, parse(SceneFile, entries, source.name, source.lines), source)


def _scene(path: Path, file: SceneFile, source: Source) -> Scene:
    with source.at("law"):
        law = find_law(file.law)
    mesh, fibres, sheets, regions = _body(path.parent, file, law, source)
    angles = file.fibres.angles_in(mesh) if file.fibres is not None else ()
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
            angles=angles,
            sheets=sheets,
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


def _parameters(file: SceneFile, source: Source) -> tuple[Parameter, ...]:
    parameters = []
    for name, entry in file.parameters.items():
        with source.at("parameters", name):
            parameters.append(Parameter(name, entry.unit, *entry.range, entry.scale))
    return tuple(parameters)


def _check_sets(mesh: Mesh, source: Source) -> None:
    """Refuse loads and supports on sets that the mesh does not have."""
    for array in ("supports", "loads"):
        for k, entries in enumerate(source.data.get(array, ())):
            for key, find in (("node_set", mesh.node_set), ("facet_set", mesh.facet_set)):
                with source.at(array, k, key, table=(array, k)):
                    if key in entries:
                        find(entries[key])


def _quantity_in(message: str, file: SceneFile) -> tuple[str, ...]:
    """Path of the first parameter or constant that a message quotes, if it quotes one."""
    for name in re.findall(r"'([^']+)'", message):
        for table in ("parameters", "constants"):
            if name in getattr(file, table):
                return table, name
    return ()


def _body(folder: Path, file: SceneFile, law: Law, source: Source) -> Parts:
    """The mesh with the sets the file adds, directions and regions if anything wants them."""
    body, regions = (several_bodies if file.bodies else one_body)(folder, file, law, source)
    mesh = _with_planes(body.mesh, file, source)
    fibres, sheets = body.fibres, body.sheets
    if file.fibres is not None:
        with source.at("fibres", table=("fibres",)):
            fibres, sheets = file.fibres.directions(mesh)
    return mesh, fibres, sheets if law.sheets else None, regions


def _with_planes(mesh: Mesh, file: SceneFile, source: Source) -> Mesh:
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
    mesh: Mesh, node_sets: Mapping[str, np.ndarray], plane: Plane, wanted: str
) -> np.ndarray:
    """Which nodes (n,) lie on the plane; some of what is ``wanted`` must."""
    coordinate = mesh.nodes[:, _AXES[plane.axis]]
    on_plane = np.abs(coordinate - plane.at) <= _ON_PLANE * mesh.size
    if plane.within is not None:
        if plane.within not in node_sets:
            raise InputError(
                f"no node set '{plane.within}' to take a part of; there are "
                f"{', '.join(sorted(node_sets)) or 'none'}"
            )
        on_plane &= np.isin(np.arange(len(mesh.nodes)), node_sets[plane.within])
    there = on_plane if wanted == "node" else on_plane[mesh.surface].all(axis=1)
    if not there.any():
        low, high = coordinate.min(), coordinate.max()
        inside = f" in '{plane.within}'" if plane.within else ""
        raise InputError(
            f"no {wanted} at {plane.axis} = {plane.at:g} mm{inside}; the body is between {low:g} "
            f"and {high:g}"
        )
    return on_plane
