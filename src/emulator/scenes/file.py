"""Scenes from TOML files.

.. code-block:: toml

    law = "neo_hookean"
    mesh = "block.vtu"                       # any format meshio reads, in mm, with its named
                                             # groups and, where the law asks, its fibres
    [node_sets.left]                         # or nodes on a plane
    axis = "x"
    at = 0.0

    [[supports]]
    node_set = "left"                        # clamped; or displacement = [0.0, 0.0, 1.0] in mm

    [[loads]]
    kind = "gravity"
    density = 1.0                            # g/cm3
    direction = [0.0, 0.0, -1.0]

    [parameters.mu]                          # what varies
    unit = "kPa"
    range = [50.0, 100.0]
    scale = "log"

    [constants]                              # what does not
    lam = 80.0
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from emulator.errors import InputError
from emulator.geometry.io import Body, read_body, read_mesh
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import find_law
from emulator.mechanics.loads import Gravity, Load
from emulator.scenes.parameters import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

_KEYS = {"law", "mesh", "node_sets", "supports", "loads", "parameters", "constants"}
_AXES = {"x": 0, "y": 1, "z": 2}


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
        text = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"scene file {path} is not valid TOML: {error}") from error
    unknown = sorted(set(text) - _KEYS)
    if unknown:
        raise InputError(
            f"scene file {path}: unknown key '{unknown[0]}'; known: {', '.join(sorted(_KEYS))}"
        )
    for key in ("law", "mesh", "parameters", "supports"):
        if key not in text:
            raise InputError(f"scene file {path}: key '{key}' is missing")
    try:
        return _scene(path, text)
    except InputError as error:
        raise InputError(f"scene file {path}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"scene file {path}: a value has the wrong form ({error!r})") from error


def _scene(path: Path, text: dict[str, Any]) -> Scene:
    law, mesh_path = find_law(text["law"]), path.parent / text["mesh"]
    body = read_body(mesh_path) if law.fibres else Body(read_mesh(mesh_path))
    mesh = body.mesh
    sets = {name: _on_plane(mesh, name, plane) for name, plane in text.get("node_sets", {}).items()}
    return Scene(
        name=path.stem,
        mesh=replace(mesh, node_sets={**mesh.node_sets, **sets}),
        law=law,
        fibres=body.fibres,
        parameters=tuple(_parameter(name, entry) for name, entry in text["parameters"].items()),
        loads=tuple(_load(load) for load in text.get("loads", [])),
        supports=tuple(
            Support(support["node_set"], np.asarray(support.get("displacement", (0.0, 0.0, 0.0))))
            for support in text["supports"]
        ),
        constants={name: float(value) for name, value in text.get("constants", {}).items()},
        recipe={"scene": "file", "path": str(path.resolve())},
    )


def _parameter(name: str, entry: dict[str, Any]) -> Parameter:
    low, high = map(float, entry["range"])
    return Parameter(name, entry.get("unit", ""), low, high, entry.get("scale", "uniform"))


def _on_plane(mesh: Mesh, name: str, plane: dict[str, Any]) -> np.ndarray:
    if plane.get("axis") not in _AXES or "at" not in plane:
        raise InputError(
            f'node set \'{name}\' needs axis = "x", "y" or "z" and at = a coordinate in mm'
        )
    distance = np.abs(mesh.nodes[:, _AXES[plane["axis"]]] - float(plane["at"]))
    nodes = np.flatnonzero(distance <= 1e-8 * mesh.size)
    if not nodes.size:
        raise InputError(f"node set '{name}': no node at {plane['axis']} = {plane['at']} mm")
    return nodes


def _load(load: dict[str, Any]) -> Load:
    options = dict(load)
    kind = options.pop("kind", None)
    if kind != "gravity":
        raise InputError(f"load kind '{kind}' is unknown; known: gravity")
    if "direction" in options:
        options["direction"] = tuple(options["direction"])
    return Gravity(**options)
