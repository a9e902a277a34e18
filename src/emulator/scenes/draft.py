"""A first scene file for a mesh, with comments on its guesses.

Sets are recognised by their names (base, fixed, endocardium, ...), the unit of length by the size
of the body. The draft is a scene that can be simulated. Entries that nothing in the mesh suggests,
such as the ranges of parameters, are marked CHANGE.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.geometry.discretisation import mesh_quality
from emulator.geometry.facets import mean_normal
from emulator.geometry.io import Body, read_body, write_mesh
from emulator.geometry.mesh import EDGES, Mesh
from emulator.geometry.surfaces import UNITS
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.file import read_scene
from emulator.scenes.loads import CavityPressure, FollowerPressure, Gravity, Load
from emulator.scenes.scene import Scene

_METRES = 0.6  # a body smaller than this in all directions is taken to be in m
_SMALL = 25.0  # a body smaller than this might be in cm
_SUPPORTS = ("base", "fix", "clamp", "held", "hold", "support", "ligament", "left", "bottom")
_INSIDE = ("endo", "cavity", "lumen", "inner", "inside")
_OUTSIDE = ("epi", "outer", "outside", "pericard")
# Ranges of known parameters: the paper's, textbook form.
_RANGES = {
    "a": (0.2, 0.52),
    "b": (1.0, 4.2),
    "a_f": (3.0, 10.36),
    "b_f": (1.0, 4.46),
    "mu": (3.5, 10.0),
    "lam": (3.5, 10.0),
    "C": (1.0, 4.0),
    "pressure": (0.53, 1.33),
}
_CONSTANTS = {"kappa": 25.0}
_MODULUS, _NUMBER = (1.0, 10.0), (1.0, 5.0)
_MOST_QUADRATIC = 20_000  # nodes that are simulated in seconds
_LINEAR = (
    "the mesh has linear tetrahedra, which lock: a ventricle of them fills by a quarter too little"
)


class Draft(NamedTuple):
    """A scene file that was written.

    path : the file.
    scene : the scene that the file describes.
    notes : sentences, one for each guess.
    """

    path: Path
    scene: Scene
    notes: tuple[str, ...]


def draft_scene(
    mesh_path: str | Path, out: str | Path, *, unit: str | None = None, law: str | None = None
) -> Draft:
    """Write a scene file for a mesh file.

    Parameters
    ----------
    mesh_path : the mesh file.
    out : the scene file, which must not exist yet.
    unit : unit of the mesh file, ``mm``, ``cm`` or ``m``; guessed from the size by default. A mesh
        that is not in mm is written again in mm, beside the scene file.
    law : name of the law; by default Holzapfel-Ogden where the mesh has fibres, or walls between
        which fibres can be computed, else Neo-Hookean.

    Raises
    ------
    InputError
        A mesh that cannot be read, an unknown law or unit, a file that exists already, or a mesh
        that cannot be supported.
    """
    mesh_path, out = Path(mesh_path), Path(out)
    if out.suffix != ".toml":
        raise InputError(f"--out {out}: the file name must end in .toml")
    if out.exists():
        raise InputError(f"{out} is there already; remove it or give --out another name")
    if unit is not None:
        look_up(UNITS, unit, "unit")
    body = read_body(mesh_path)
    notes: list[str] = []
    if unit is None:
        extent = float(np.ptp(body.mesh.nodes, axis=0).max())
        unit = "mm" if extent >= _METRES else "m"
        hint = "; if it is in cm, give --unit cm" if unit == "mm" and extent < _SMALL else ""
        notes.append(f"the body is {extent:.4g} long: taken to be {unit}{hint}")
    out.parent.mkdir(parents=True, exist_ok=True)
    body, mesh_name = _in_mm(body, mesh_path, out, unit, notes)
    mesh = body.mesh
    if mesh.order == 1:
        notes.append(_LINEAR)
    quality = mesh_quality(mesh)
    if quality.flat or quality.parts > 1:
        notes.append(quality.sentence())
    walls = _walls(mesh)
    if law is None:
        why = "the mesh has fibres" if body.fibres is not None else "its walls are named"
        fibrous = body.fibres is not None or walls is not None
        law = "holzapfel_ogden" if fibrous else "neo_hookean"
        notes.append(f"law {law}: {why if fibrous else 'the mesh has no fibres'}")
    material, support = find_law(law), _support(mesh, notes)
    head = [
        f'law = "{material.name}"   # see docs/extending.md for others',
        f'mesh = "{mesh_name}"',
        *_elements(mesh),
    ]
    sections = ["\n".join(head)]
    if material.fibres and body.fibres is None:
        sections.append(_fibres(mesh, walls))
    for load, lines, note in _loads(mesh):
        quantities = _quantities([*material.quantities, *load.quantities])
        entries = "\n\n".join([*sections, support, lines, *quantities]) + "\n"
        all_notes = (*notes, note, *_unused(mesh, entries))
        out.write_text(_header(mesh, all_notes) + entries, encoding="utf-8")
        try:
            return Draft(out, read_scene(out), all_notes)
        except InputError as error:
            out.unlink()
            failure = error
        notes.append(f"not the load '{load.kind}': {failure}")
    raise failure


def _in_mm(body: Body, path: Path, out: Path, unit: str, notes: list[str]) -> tuple[Body, str]:
    """Return the body in mm, and the path of its file relative to the scene file."""
    if unit == "mm":
        folder, path = out.resolve().parent, path.resolve()
        name = path.relative_to(folder) if path.is_relative_to(folder) else path
        return body, name.as_posix()
    mesh = replace(body.mesh, nodes=UNITS[unit] * body.mesh.nodes)
    target = out.with_name(f"{path.stem}_mm.vtu")
    if target.exists():
        raise InputError(f"{target}, the mesh in mm, is there already; remove it")
    write_mesh(target, mesh, body.fibres, body.sheets)
    notes.append(f"written again in mm as {target.name}")
    return replace(body, mesh=mesh), target.name


def _find_set(sets: Mapping[str, np.ndarray], words: tuple[str, ...]) -> str | None:
    """Return the first set whose name contains one of ``words``, the likeliest word first."""
    return next((name for word in words for name in sets if word in name.lower()), None)


def _walls(mesh: Mesh) -> tuple[str, str] | None:
    """Return the facet sets between which fibres can be computed, or None."""
    inner, outer = (_find_set(mesh.facet_sets, words) for words in (_INSIDE, _OUTSIDE))
    return (inner, outer) if inner and outer else None


def _fibres(mesh: Mesh, walls: tuple[str, str] | None) -> str:
    """Return the lines of the fibre rule."""
    if walls is None:
        return '[fibres]   # CHANGE\nrule = "uniform"\ndirection = [1.0, 0.0, 0.0]'
    base = _find_set(mesh.facet_sets, ("base",))
    axis = "axis = [0.0, 0.0, 1.0]   # CHANGE: from apex to base"
    if base is not None:
        # Rounded, so that a base that is level to round-off gives a level axis, without -0.
        normal = (np.round(mean_normal(mesh.nodes[mesh.facet_set(base)]), 6) + 0.0).tolist()
        axis = f"axis = {normal}   # from apex to base, across '{base}'"
    return f"""[fibres]
rule = "helix"
angles = [60.0, -60.0]   # degrees, inside and outside
endocardium = "{walls[0]}"
epicardium = "{walls[1]}"
{axis}"""


def _elements(mesh: Mesh) -> list[str]:
    """Return the lines that keep linear tetrahedra from locking."""
    if mesh.order == 2:
        return []
    edges = np.sort(mesh.elements[:, EDGES], axis=2).reshape(-1, 2)
    count = len(mesh.nodes) + len(np.unique(edges, axis=0))
    if count <= _MOST_QUADRATIC:
        return [f"order = 2   # quadratic elements, {count} nodes"]
    return [
        'dilatation = "patch"   # elements share volume changes, so that they do not lock',
        f"# order = 2: quadratic elements are better, but {count} nodes; mesh the body coarser",
    ]


def _support(mesh: Mesh, notes: list[str]) -> str:
    """Return the lines of the support."""
    name = _find_set(mesh.node_sets, _SUPPORTS)
    if name is not None:
        notes.append(f"held at '{name}'")
        return f'[[supports]]\nnode_set = "{name}"   # all components; see components = "z"'
    axis = int(np.argmax(np.ptp(mesh.nodes, axis=0)))
    letter, at = "xyz"[axis], float(mesh.nodes[:, axis].min())
    sets = ", ".join(mesh.node_sets) or "none"
    notes.append(
        f"no set is named like a support ({sets}): held where {letter} is least, {at:.6g} mm; "
        "change it"
    )
    return f"""[node_sets.held]   # CHANGE: no set is named like a support
axis = "{letter}"
at = {at!r}

[[supports]]
node_set = "held\""""


def _loads(mesh: Mesh) -> list[tuple[Load, str, str]]:
    """Return the loads to try, each with its lines and a note."""
    loads: list[tuple[Load, str, str]] = []
    wall = _find_set(mesh.facet_sets, _INSIDE)
    if wall is not None:
        for kind in (CavityPressure, FollowerPressure):
            lines = f'[[loads]]\nkind = "{kind.kind}"\nfacet_set = "{wall}"\n'
            lines += "# pressure = 0.8   # kPa; without it, a parameter"
            loads.append((kind(wall), lines, f"pressure on '{wall}'"))
    gravity = f'[[loads]]   # CHANGE\nkind = "{Gravity.kind}"\ndensity = 1.06   # g/cm3\n'
    note = "its own weight along -z is the load; change it if you know another"
    return [*loads, (Gravity(), gravity + "direction = [0.0, 0.0, -1.0]", note)]


def _quantities(quantities: Sequence[Quantity]) -> list[str]:
    """Return a table for each parameter, and that of the constants."""
    sections, constants = [], []
    for quantity in quantities:
        if quantity.name in _CONSTANTS:
            constants.append(f"{quantity.name} = {_CONSTANTS[quantity.name]}")
            continue
        low, high = _RANGES.get(quantity.name, _MODULUS if quantity.unit else _NUMBER)
        if not quantity.low < low < high < quantity.high:
            span = quantity.high - quantity.low
            low, high = quantity.low + 0.25 * span, quantity.low + 0.75 * span
        scale = '\nscale = "log"' if low > 0.0 and quantity.name != "pressure" else ""
        sections.append(
            f'[parameters.{quantity.name}]\nunit = "{quantity.unit}"\n'
            f"range = [{low}, {high}]   # CHANGE: what you think possible{scale}"
        )
    return [*sections, *(["\n".join(["[constants]", *constants])] if constants else ())]


def _unused(mesh: Mesh, text: str) -> list[str]:
    """Return a note on facet sets that the scene file does not use, and a load for them."""
    names = [name for name in mesh.facet_sets if f'"{name}"' not in text]
    if not names:
        return []
    return [
        f'not used: {", ".join(names)}; a force on one: [[loads]] with kind = "traction", '
        f'facet_set = "{names[0]}", traction = [0.0, 0.0, 1.0] in kPa'
    ]


def _header(mesh: Mesh, notes: Sequence[str]) -> str:
    """Return the comments above the entries: the notes, and the sets of the mesh."""
    sets = [f"#   {name}: {len(nodes)} nodes" for name, nodes in mesh.node_sets.items()]
    sets += [f"#   {name}: {len(rows)} facets" for name, rows in mesh.facet_sets.items()]
    lines = [
        "# A first scene file; lengths in mm, stresses in kPa. What is marked CHANGE was guessed.",
        *(f"# - {note}" for note in notes),
        "# Sets of the mesh:",
        *(sets or ["#   none"]),
    ]
    return "\n".join([*lines, "", ""])
