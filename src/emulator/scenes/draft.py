"""A first scene file for a mesh, with comments on its guesses.

Sets are recognised by their names (base, fixed, endocardium, LV, ...), the unit of length by the
size of the body. Where no set is a support, the largest flat face at an end of the body is held,
or the end itself. The draft is a scene that can be simulated. Priors of parameters are those of
published values, with their source. Entries that nothing suggests are marked CHANGE.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.units import IN_MM
from emulator.geometry.discretisation import mesh_quality
from emulator.geometry.facets import mean_normal
from emulator.geometry.fibres import BOTH
from emulator.geometry.io import Body, read_body, write_mesh
from emulator.geometry.mesh import EDGES, Mesh, cross_sides
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.file import read_scene
from emulator.scenes.loads import CavityPressure, FollowerPressure, Gravity, Load, SurfacePressure
from emulator.scenes.parameter_space import LogNormal
from emulator.scenes.scene import Scene, with_mesh
from emulator.scenes.supports.dirichlet import Support, loose_parts
from emulator.scenes.tissue_priors import OF_LAWS, PRESSURE

_METRES = 0.6  # a body smaller than this in all directions is taken to be in m
_SMALL = 25.0  # a body smaller than this might be in cm
_MICROMETRES = 3000.0  # a body larger than this in one direction is taken to be in um
# Names of sets contain these words, in small letters; the likeliest come first.
_NO_WALL = r"^(?!.*(endo|epi|cavity|lumen|inner|inside|outer|outside)).*"
_SUPPORTS = (
    f"{_NO_WALL}base",
    *("fix", "clamp", "held", "hold", "support", "ligament"),
    rf"{_NO_WALL}\bleft\b(?! (ventric|atri))",
    f"{_NO_WALL}bottom",
)
_INSIDE = ("endo", "cavity", "lumen", "inner", "inside", r"\blv\b", "left ventric", r"\brv\b")
_OUTSIDE = ("epi", "outer", "outside", "pericard", r"\bwall\b")
_LEAST_FACE = 0.005  # of the surface; a flat face this large holds the body
_LEAST_END = 0.15  # likewise of an end that is not flat
_FLAT = 1e-8  # of the body's size
# Guesses where no published values are at hand, kPa or numbers.
_RANGES = {"mu": (3.5, 10.0), "lam": (3.5, 10.0), "right_pressure": (0.1, 0.4)}
_MODULUS, _NUMBER = (1.0, 10.0), (1.0, 5.0)
_CONSTANTS = {"kappa": 25.0}
_WEIGHT, _MOST_STRESS = 1.04e-2, 5.0  # kPa/mm; kPa, which the moduli stand
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
    unit : unit of the mesh file, ``mm``, ``cm``, ``m`` or ``um``; guessed from the size by
        default. A mesh that is not in mm is written again in mm, beside the scene file.
    law : name of the law; by default Holzapfel-Ogden where the mesh has fibres, or walls between
        which fibres can be computed, else Neo-Hookean.

    Raises
    ------
    InputError
        A mesh that cannot be read, an unknown law or unit, a file that exists already, or a mesh
        that cannot be supported.
    """
    mesh_path, out = Path(mesh_path), Path(out)
    _check(out, unit, law)
    body = read_body(mesh_path)
    notes: list[str] = []
    if unit is None:
        unit, note = guessed_unit(float(np.ptp(body.mesh.nodes, axis=0).max()))
        notes.append(note)
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
        law = _usual_law(notes, fibres=body.fibres is not None, walls=walls is not None)
    material, support = find_law(law), _support(mesh, notes)
    head = [
        f'law = "{material.name}"   # see docs/extending.md for others',
        f"mesh = {quoted(mesh_name)}",
        *without_locking(mesh),
    ]
    if body.unused:
        unused = ", ".join(body.unused)
        if unit != "mm":  # the mesh in mm has no regions
            unused = re.sub(r' \(regions = "[^"]*"\)', "", unused)
        notes.append(f"in the mesh file and not used: {unused}")
    sections = ["\n".join(head)]
    if material.fibres and body.fibres is None:
        sections.append(_fibres(mesh, walls, material.sheets))
    for loads, lines, note, stiffer in _loads(mesh):
        of_loads = [quantity for load in loads for quantity in load.quantities]
        priors = {**OF_LAWS.get(material.name, {}), SurfacePressure.parameter: PRESSURE}
        quantities = _quantities([*material.quantities, *of_loads], priors, stiffer)
        entries = "\n\n".join([*sections, support, lines, *quantities]) + "\n"
        all_notes = (*notes, note, *_unused(mesh, entries))
        out.write_text(_header(mesh, all_notes) + entries, encoding="utf-8")
        try:
            return Draft(out, with_mesh(read_scene(out)), all_notes)
        except InputError as error:
            out.unlink()
            failure = re.sub(rf"^scene file {re.escape(str(out))}(, line \d+)?: ", "", str(error))
        notes.append(f"not the load '{loads[0].kind}': {failure}")
    if mesh_name == f"{mesh_path.stem}_mm.vtu" and unit != "mm":
        out.with_name(mesh_name).unlink()
    raise InputError(f"mesh file {mesh_path}: {failure}")


def _check(out: Path, unit: str | None, law: str | None) -> None:
    """Refuse what is wrong before anything is written."""
    if out.suffix != ".toml":
        raise InputError(f"--out {out}: the file name must end in .toml")
    if out.exists():
        raise InputError(f"{out} is there already; remove it or give --out another name")
    if unit is not None:
        look_up(IN_MM, unit, "unit")
    if law is not None:
        find_law(law)


def _usual_law(notes: list[str], *, fibres: bool, walls: bool) -> str:
    """Return the law of a mesh that has fibres, or walls between which they can be computed."""
    why = "the mesh has fibres" if fibres else "its walls are named"
    law = "holzapfel_ogden" if fibres or walls else "neo_hookean"
    notes.append(f"law {law}: {why if fibres or walls else 'the mesh has no fibres'}")
    return law


def guessed_unit(extent: float) -> tuple[str, str]:
    """Return the unit of length that a body's greatest extent suggests, and a sentence on it."""
    unit = "um" if extent > _MICROMETRES else "mm" if extent >= _METRES else "m"
    hint = "; if it is in cm, give --unit cm" if unit == "mm" and extent < _SMALL else ""
    return unit, f"the body is {extent:.4g} long: taken to be {unit}{hint}"


def _in_mm(body: Body, path: Path, out: Path, unit: str, notes: list[str]) -> tuple[Body, str]:
    """Return the body in mm, and the path of its file relative to the scene file."""
    if unit == "mm":
        folder, path = out.resolve().parent, path.resolve()
        name = path.relative_to(folder) if path.is_relative_to(folder) else path
        return body, name.as_posix()
    mesh = replace(body.mesh, nodes=IN_MM[unit] * body.mesh.nodes)
    target = out.with_name(f"{path.stem}_mm.vtu")
    if target.exists():
        raise InputError(f"{target}, the mesh in mm, is there already; remove it")
    write_mesh(target, mesh, body.fibres, body.sheets)
    notes.append(f"written again in mm as {target.name}")
    return replace(body, mesh=mesh), target.name


def quoted(name: str) -> str:
    """Return a name as a string of TOML."""
    return json.dumps(name, ensure_ascii=False)


def _find_set(sets: Iterable[str], words: tuple[str, ...]) -> str | None:
    """Return the set whose name matches the earliest of ``words``, the left ventricle's first."""
    names = {}
    for name in sets:
        parted = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
        names[name] = " ".join(re.findall("[a-z]+", parted.lower()))
    for word in words:
        matches = [name for name, label in names.items() if re.search(word, label)]
        if matches:
            return min(matches, key=lambda name: bool(re.search(r"\b(rv|right)\b", names[name])))
    return None


def _find_wall(mesh: Mesh, words: tuple[str, ...]) -> str | None:
    """Return the facet set whose name contains one of ``words`` and that is no support."""
    return _find_set((n for n in mesh.facet_sets if not _find_set([n], _SUPPORTS)), words)


def _walls(mesh: Mesh) -> tuple[str, str] | None:
    """Return the facet sets between which fibres can be computed, or None."""
    inner, outer = (_find_wall(mesh, words) for words in (_INSIDE, _OUTSIDE))
    return (inner, outer) if inner and outer else None


def _fibres(mesh: Mesh, walls: tuple[str, str] | None, with_sheets: bool) -> str:
    """Return the lines of the fibre rule."""
    if walls is None:
        sheets = "\nsheets = [0.0, 1.0, 0.0]" if with_sheets else ""
        return f'[fibres]   # CHANGE\nrule = "uniform"\ndirection = [1.0, 0.0, 0.0]{sheets}'
    base = _find_set(mesh.facet_sets, _SUPPORTS[:1])
    axis = "axis = [0.0, 0.0, 1.0]   # CHANGE: from apex to base"
    if base is not None:
        # Rounded, so that a base that is level to round-off gives a level axis, without -0.
        normal = (np.round(mean_normal(mesh.nodes[mesh.facet_set(base)]), 6) + 0.0).tolist()
        axis = f"axis = {normal}   # from apex to base, across '{base}'"
    if _of_both(mesh):
        angles = "angles = [60.0, -60.0]   # degrees, inside and outside"
        return f'[fibres]\nrule = "biventricle"\n{angles}\n{axis}'
    return f"""[fibres]
rule = "helix"
angles = [60.0, -60.0]   # degrees, inside and outside
endocardium = {quoted(walls[0])}
epicardium = {quoted(walls[1])}
{axis}"""


def without_locking(mesh: Mesh) -> list[str]:
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
    """Return the lines of the supports, under which no part of the body can move or turn."""
    name = _find_set(mesh.node_sets, _SUPPORTS)
    sets = ", ".join(mesh.node_sets) or "none"
    why, sections = f"no set is named like a support ({sets})", []
    if name is not None:
        notes.append(f"held at '{name}'")
        why = f"'{name}' alone leaves the body free to turn or move"
        components = '   # all components; see components = "z"'
        sections.append(f"[[supports]]\nnode_set = {quoted(name)}{components}")
    loose = loose_parts(mesh, [Support(name)] if name else [])
    for k, (nodes, _) in enumerate(loose, start=1):
        letter, at, where = _end(mesh, nodes)
        if f'axis = "{letter}"\nat = {at}\n' in "".join(sections):
            continue  # held with another part
        set_name = f"held_{k}" if k > 1 else "held"
        while set_name in mesh.node_sets:
            set_name += "_"
        notes.append(f"{why}: held where {letter} is {where} mm; change it")
        sections.append(
            f"[node_sets.{set_name}]   # CHANGE: {why.split(' (')[0]}\n"
            f'axis = "{letter}"\nat = {at}\n\n[[supports]]\nnode_set = "{set_name}"'
        )
        why = "another part of the mesh"
    return "\n\n".join(sections)


def _end(mesh: Mesh, nodes: np.ndarray) -> tuple[str, float | list[float], str]:
    """Return where to fix the part of these nodes: axis, coordinates mm as TOML, and as text.

    On a flat face at an end, the end first where its longest axis is least; or between two planes
    that cut off that end.
    """
    corners = mesh.nodes[mesh.surface[np.isin(mesh.surface[:, 0], nodes)][:, :3]]
    area = np.linalg.norm(cross_sides(corners), axis=1)
    box = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    longest = int(np.argmax(box[1] - box[0]))

    def depth(axis: int, side: int, share: float) -> float:
        """Return how deep an end is, mm, that has this share of the surface."""
        depths = np.abs(corners[..., axis] - box[side][axis]).max(axis=1)
        order = np.argsort(depths)
        return float(depths[order][np.searchsorted(np.cumsum(area[order]), share * area.sum())])

    for axis in (longest, 0, 1, 2):
        for side, word in enumerate(("least", "greatest")):
            if depth(axis, side, _LEAST_FACE) <= _FLAT * mesh.size:
                place = float(box[side][axis])
                return "xyz"[axis], place, f"{word}, {place:.6g}"
    low = float(box[0][longest])
    high = low + depth(longest, 0, _LEAST_END)
    return "xyz"[longest], [low, high], f"between {low:.6g} and {high:.6g}"


def _loads(mesh: Mesh) -> list[tuple[list[Load], str, str, float]]:
    """Return the loads to try, with their lines, a note, and by how much moduli are raised.

    Under its own weight, they are raised so that a beam of the body's size stands it.
    """
    loads: list[tuple[list[Load], str, str, float]] = []
    wall = _find_wall(mesh, _INSIDE)
    if wall is not None:
        for kind in (CavityPressure, FollowerPressure):
            pressures = [kind(wall)]
            if _of_both(mesh):
                pressures.append(kind(BOTH[1], parameter="right_pressure"))
            lines = "\n\n".join(map(_pressure, pressures))
            note = " and ".join(f"'{pressure.facet_set}'" for pressure in pressures)
            loads.append(([*pressures], lines, f"pressure on {note}", 1.0))
    gravity = f'[[loads]]   # CHANGE\nkind = "{Gravity.kind}"\ndensity = 1.06   # g/cm3\n'
    note = "its own weight along -z is the load; change it if you know another"
    extent = np.ptp(mesh.nodes, axis=0)
    stress = 3.0 * _WEIGHT * extent.max() ** 2 / extent.min()
    stiffer = max(1.0, float(f"{stress / _MOST_STRESS:.1g}"))
    return [*loads, ([Gravity()], gravity + "direction = [0.0, 0.0, -1.0]", note, stiffer)]


def _pressure(load: SurfacePressure) -> str:
    """Return the lines of a pressure."""
    lines = f'[[loads]]\nkind = "{load.kind}"\nfacet_set = {quoted(load.facet_set)}\n'
    if load.parameter != SurfacePressure.parameter:
        lines += f'parameter = "{load.parameter}"\n'
    return lines + "# pressure = 0.8   # kPa; without it, a parameter"


def _of_both(mesh: Mesh) -> bool:
    """Return whether the mesh has the walls of both ventricles, under the names of their rule."""
    return set(BOTH) <= set(mesh.facet_sets)


def _quantities(
    quantities: Sequence[Quantity], priors: Mapping[str, LogNormal], stiffer: float
) -> list[str]:
    """Return a table for each parameter, and that of the constants.

    priors : those from published values, by the parameter's name.
    """
    sections, constants = [], []
    for quantity in quantities:
        if quantity.name in _CONSTANTS:
            constants.append(f"{quantity.name} = {_CONSTANTS[quantity.name] * stiffer}")
            continue
        raised = stiffer if quantity.unit == "kPa" else 1.0
        sections.append(
            f'[parameters.{quantity.name}]\nunit = "{quantity.unit}"\n'
            + "\n".join(_prior(quantity, priors.get(quantity.name), raised))
        )
    return [*sections, *(["\n".join(["[constants]", *constants])] if constants else ())]


def _prior(quantity: Quantity, published: LogNormal | None, raised: float) -> list[str]:
    """Return the lines of a parameter's prior, whose median is ``raised`` by a factor.

    A log-normal where the parameter is above zero and has no other limit, else a range.
    """
    by_weight = f", times {raised:g} to stand its weight" if raised > 1.0 else ""
    if published is not None:
        median, log_sd, source = published.median, published.log_sd, published.source
        return prior_lines(raised * median, log_sd, source + by_weight)
    low, high = _RANGES.get(quantity.name, _MODULUS if quantity.unit else _NUMBER)
    low, high = raised * low, raised * high
    if (quantity.low, quantity.high) == (0.0, np.inf):
        source = f"a guess{by_weight}: log-sd 1"
        return prior_lines(float(f"{np.sqrt(low * high):.2g}"), 1.0, source, "   # CHANGE: a guess")
    if not quantity.low < low < high < quantity.high:
        span = quantity.high - quantity.low
        low, high = quantity.low + 0.25 * span, quantity.low + 0.75 * span
    return [f"range = [{low}, {high}]   # CHANGE: what you think possible"]


def prior_lines(median: float, log_sd: float, source: str, comment: str = "") -> list[str]:
    """Return the lines of a log-normal prior in a parameter's table."""
    return [f"median = {median:.4g}{comment}", f"log_sd = {log_sd:g}", f"source = {quoted(source)}"]


def _unused(mesh: Mesh, text: str) -> list[str]:
    """Return a note on sets that the scene file does not use, and a load for them."""
    names = [name for name in mesh.node_sets if quoted(name) not in text]
    facets = [name for name in names if name in mesh.facet_sets]
    if not names:
        return []
    entries = 'kind = "force", node_set = {}, resultant = [0.0, 0.0, 1.0] in N'
    if facets:
        entries = 'kind = "traction", facet_set = {}, traction = [0.0, 0.0, 1.0] in kPa'
    entries = entries.format(quoted((facets or names)[0]))
    return [f"not used: {', '.join(names)}; a force on one: [[loads]] with {entries}"]


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
