"""A first scene file for a mesh, with comments on its guesses.

Sets are recognised by their names (base, fixed, endocardium, ...), the unit of length by the size
of the body. The draft is a scene that can be simulated. Entries that nothing in the mesh suggests,
such as the ranges of parameters, are marked CHANGE.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.geometry.facets import mean_normal
from emulator.geometry.io import Body, read_body, write_mesh
from emulator.geometry.mesh import EDGES, Mesh
from emulator.geometry.quality import mesh_quality
from emulator.geometry.surfaces import UNITS
from emulator.mechanics.laws import Law, find_law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.file import read_scene
from emulator.scenes.loads import CavityPressure, FollowerPressure, Gravity, Load
from emulator.scenes.scene import Scene

_METRES = 0.6  # a body smaller than this in all directions is taken to be in m
_SMALL = 25.0  # a body smaller than this might be in cm
_SUPPORTS = ("base", "fix", "clamp", "held", "hold", "support", "ligament", "left", "bottom")
_BASE = ("base",)
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


@dataclass(frozen=True, eq=False)
class Draft:
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
    unit = unit or _guessed_unit(body.mesh, notes)
    out.parent.mkdir(parents=True, exist_ok=True)
    body, mesh_name = _in_mm(body, mesh_path, out, unit, notes)
    if body.mesh.order == 1:
        notes.append(_LINEAR)
    quality = mesh_quality(body.mesh)
    if quality.flat or quality.parts > 1:
        notes.append(quality.sentence())
    material = _law(body, law, notes)
    support = _support(body.mesh, notes)
    for load, lines, note in _loads(body.mesh):
        entries = _entries(body, mesh_name, material, support, (load, lines))
        all_notes = [*notes, note, *_unused(body.mesh, entries)]
        out.write_text(_header(body.mesh, all_notes) + entries, encoding="utf-8")
        try:
            return Draft(out, read_scene(out), tuple(all_notes))
        except InputError as error:
            out.unlink()
            failure = error
        notes.append(f"not the load '{load.kind}': {failure}")
    raise failure


def _guessed_unit(mesh: Mesh, notes: list[str]) -> str:
    extent = float(np.ptp(mesh.nodes, axis=0).max())
    unit = "mm" if extent >= _METRES else "m"
    hint = "; if it is in cm, give --unit cm" if unit == "mm" and extent < _SMALL else ""
    notes.append(f"the body is {extent:.4g} long: taken to be {unit}{hint}")
    return unit


def _in_mm(body: Body, path: Path, out: Path, unit: str, notes: list[str]) -> tuple[Body, str]:
    """Return the body in mm, and the path of its file relative to the scene file."""
    if unit == "mm":
        folder = out.resolve().parent
        inside = path.resolve().is_relative_to(folder)
        name = path.resolve().relative_to(folder) if inside else path.resolve()
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


def _law(body: Body, name: str | None, notes: list[str]) -> Law:
    if name is not None:
        return find_law(name)
    fibres = body.fibres is not None or _helix(body.mesh) is not None
    law = find_law("holzapfel_ogden" if fibres else "neo_hookean")
    why = "the mesh has fibres" if body.fibres is not None else "its walls are named"
    notes.append(f"law {law.name}: {why if fibres else 'the mesh has no fibres'}")
    return law


def _helix(mesh: Mesh) -> tuple[str, str] | None:
    """Return the facet sets between which fibres can be computed, or None."""
    inner, outer = (_find_set(mesh.facet_sets, words) for words in (_INSIDE, _OUTSIDE))
    return (inner, outer) if inner and outer else None


def _axis(mesh: Mesh) -> str:
    """Return the line of the long axis: the normal of the base, where there is a base."""
    base = _find_set(mesh.facet_sets, _BASE)
    if base is None:
        return "axis = [0.0, 0.0, 1.0]   # CHANGE: from apex to base"
    # Rounded, so that a base that is level to round-off gives a level axis, without -0.
    normal = (np.round(mean_normal(mesh.nodes[mesh.facet_set(base)]), 6) + 0.0).tolist()
    return f"axis = {normal}   # from apex to base, across '{base}'"


def _loads(mesh: Mesh) -> list[tuple[Load, str, str]]:
    """Return the loads to try, each with its lines and a note."""
    loads: list[tuple[Load, str, str]] = []
    wall = _find_set(mesh.facet_sets, _INSIDE)
    if wall is not None:
        for kind in (CavityPressure, FollowerPressure):
            lines = f'[[loads]]\nkind = "{kind.kind}"\nfacet_set = "{wall}"\n'
            lines += "# pressure = 0.8   # kPa; without it, a parameter\n"
            loads.append((kind(wall), lines, f"pressure on '{wall}'"))
    gravity = f'[[loads]]   # CHANGE\nkind = "{Gravity.kind}"\ndensity = 1.06   # g/cm3\n'
    note = "its own weight along -z is the load; change it if you know another"
    return [*loads, (Gravity(), gravity + "direction = [0.0, 0.0, -1.0]\n", note)]


def _unused(mesh: Mesh, text: str) -> list[str]:
    """Return a note on facet sets that the scene file does not use, and a load for them."""
    names = [name for name in mesh.facet_sets if f'"{name}"' not in text]
    if not names:
        return []
    return [
        f'not used: {", ".join(names)}; a force on one: [[loads]] with kind = "traction", '
        f'facet_set = "{names[0]}", traction = [0.0, 0.0, 1.0] in kPa'
    ]


def _support(mesh: Mesh, notes: list[str]) -> str:
    """Return the lines of the support."""
    name = _find_set(mesh.node_sets, _SUPPORTS)
    if name is not None:
        notes.append(f"held at '{name}'")
        return f'[[supports]]\nnode_set = "{name}"   # all components; see components = "z"\n'
    axis = int(np.argmax(np.ptp(mesh.nodes, axis=0)))
    at = float(mesh.nodes[:, axis].min())
    sets = ", ".join(mesh.node_sets) or "none"
    letter = "xyz"[axis]
    notes.append(
        f"no set is named like a support ({sets}): held where {letter} is least, {at:.6g} mm; "
        "change it"
    )
    return (
        f'[node_sets.held]   # CHANGE: no set is named like a support\naxis = "{letter}"\n'
        f'at = {at!r}\n\n[[supports]]\nnode_set = "held"\n'
    )


def _header(mesh: Mesh, notes: list[str]) -> str:
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


def _entries(body: Body, mesh_name: str, law: Law, support: str, load: tuple[Load, str]) -> str:
    """Return the entries of the scene file; ``support`` and the load's second item are lines."""
    mesh = body.mesh
    parts = [
        f'law = "{law.name}"   # see docs/extending.md for others',
        f'mesh = "{mesh_name}"',
        *_elements(mesh),
        "",
        *(_fibres(mesh) if law.fibres and body.fibres is None else ()),
        support,
        load[1],
    ]
    quantities = [*law.quantities, *load[0].quantities]
    for quantity in quantities:
        if quantity.name not in _CONSTANTS:
            parts += _parameter(quantity)
    constants = [f"{q.name} = {_CONSTANTS[q.name]}" for q in quantities if q.name in _CONSTANTS]
    return "\n".join([*parts, *(["[constants]", *constants, ""] if constants else ())])


def _fibres(mesh: Mesh) -> list[str]:
    """Return the lines of the fibre rule."""
    walls = _helix(mesh)
    if walls is None:
        return ["[fibres]   # CHANGE", 'rule = "uniform"', "direction = [1.0, 0.0, 0.0]", ""]
    return [
        "[fibres]",
        'rule = "helix"',
        "angles = [60.0, -60.0]   # degrees, inside and outside",
        f'endocardium = "{walls[0]}"',
        f'epicardium = "{walls[1]}"',
        _axis(mesh),
        "",
    ]


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


def _parameter(quantity: Quantity) -> list[str]:
    low, high = _RANGES.get(quantity.name, _MODULUS if quantity.unit else _NUMBER)
    if not quantity.low < low < high < quantity.high:
        span = quantity.high - quantity.low
        low, high = quantity.low + 0.25 * span, quantity.low + 0.75 * span
    scale = ['scale = "log"'] if low > 0.0 and quantity.name != "pressure" else []
    return [
        f"[parameters.{quantity.name}]",
        f'unit = "{quantity.unit}"',
        f"range = [{low}, {high}]   # CHANGE: what you think possible",
        *scale,
        "",
    ]
