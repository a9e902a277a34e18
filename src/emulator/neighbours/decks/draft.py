"""A mesh file and a scene file from a deck.

Parameters get log-normal priors about the deck's values, moduli with a log-sd of 1 and numbers with
0.7, as :mod:`emulator.scenes.tissue_priors` has them where no spread is published; a number with
limits gets a range about its value. Bulk moduli are constants. Loads are numbers.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import MISSING, Field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.units import IN_KPA, IN_MM
from emulator.geometry.io import write_mesh
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.law import Quantity
from emulator.neighbours.decks.abaqus import read_abaqus
from emulator.neighbours.decks.deck import Deck, DeckFile
from emulator.neighbours.decks.febio import read_febio
from emulator.neighbours.decks.svmultiphysics import ROOTS, read_svmultiphysics
from emulator.scenes.draft import guessed_unit, quoted, without_locking
from emulator.scenes.file import read_scene
from emulator.scenes.part import Part
from emulator.scenes.scene import Scene, with_mesh
from emulator.scenes.tissue_priors import LOG_SD, LOG_SD_OF_NUMBERS

_HEAD = 100_000  # bytes of a file by which its program is recognised
_CONSTANTS = ("kappa",)
_HALF = 0.5  # of a value, to each side, where a log-normal has no place
_TO_LIMIT = 0.9  # of the way to a limit, at most
# Powers of stress and of length in the units of the fields of loads and supports.
_POWERS = {
    "pressure": (1, 0), "traction": (1, 0), "displacement": (0, 1), "resultant": (1, 2),
    "stiffness": (1, -1), "density": (1, -1),
}  # fmt: skip


class DeckDraft(NamedTuple):
    """A scene file that was written from a deck.

    path : the file.
    scene : the scene that the file describes.
    notes : sentences on units and equations.
    unread : a sentence for each line of the deck that was not understood.
    """

    path: Path
    scene: Scene
    notes: tuple[str, ...]
    unread: tuple[str, ...]


def reader_of(path: Path) -> Callable[[DeckFile], Deck] | None:
    """Return the reader of a deck by its suffix and content; None for a mesh, or another file."""
    suffix = path.suffix.lower()
    if suffix == ".feb":
        return read_febio
    if suffix not in (".inp", ".xml") or not path.is_file():
        return None
    if suffix == ".inp":
        text = path.read_text(encoding="utf-8", errors="replace")
        return read_abaqus if re.search(r"(?im)^\s*\*\s*(material|step)\b", text) else None
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return read_svmultiphysics if any(f"<{root}".encode() in head for root in ROOTS) else None


def draft_deck(path: Path, out: Path, unit: str | None = None) -> DeckDraft:
    """Write mesh and scene file of a deck.

    Parameters
    ----------
    path : the deck.
    out : the scene file, or the folder that gets one of the deck's name.
    unit : units of length and stress of the deck, such as ``mm,MPa``; a length that is not named
        is guessed from the body's size, a stress is kPa.

    Raises
    ------
    InputError
        A deck that cannot be read, that has a law, a load or an element that this package has not,
        an unknown unit, or a file that exists already.
    """
    out = out if out.suffix == ".toml" else out / f"{path.stem}.toml"
    mesh_path = out.with_name(f"{path.stem}_mm.vtu")
    for target in (out, mesh_path):
        if target.exists():
            raise InputError(f"{target} is there already; remove it or give --out another name")
    length, stress = _units(unit)
    reader = reader_of(path)
    if reader is None:
        raise InputError(f"{path} is no deck of FEBio, Abaqus or svMultiPhysics")
    deck = reader(file := DeckFile(path))
    notes = [*deck.notes]
    if length is None:
        length, note = guessed_unit(float(np.ptp(deck.mesh.nodes, axis=0).max()))
        notes.insert(0, note)
    if stress is None:
        stress = "kPa"
        notes.insert(
            1, f"stresses are taken to be kPa; if they are in MPa, give --unit {length},MPa"
        )
    if deck.is_split:
        notes.append("the deck's hexahedra and prisms are split into tetrahedra: other elements")
    elif deck.mesh.order == 1:
        notes.append("the elements are the deck's linear tetrahedra, which lock; see order")
    mesh = replace(deck.mesh, nodes=IN_MM[length] * deck.mesh.nodes)
    text = _scene(deck, path, mesh_path.name, IN_MM[length], IN_KPA[stress])
    unread = deck.unread
    comments = f"# From the {deck.program} deck {path.name}; lengths in mm, stresses in kPa.\n"
    comments += "".join(f"# - {sentence}\n" for sentence in (*notes, *unread))
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        if not deck.supports:
            raise InputError("it prescribes no displacement, the body could move freely")
        write_mesh(mesh_path, mesh, *_directions(deck))
        out.write_text(f"{comments}\n{text}\n", encoding="utf-8")
        return DeckDraft(out, with_mesh(read_scene(out)), tuple(notes), unread)
    except InputError as error:
        for target in (out, mesh_path):
            target.unlink(missing_ok=True)
        reason = re.sub(rf"^scene file {re.escape(str(out))}(, line \d+)?: ", "", str(error))
        missed = (
            f"; {len(unread)} lines are not understood, the first {unread[0]}" if unread else ""
        )
        raise InputError(f"deck {file.path}: {reason}{missed}") from error


def _units(unit: str | None) -> tuple[str | None, str | None]:
    """Return the units of length and of stress that a text such as ``mm,MPa`` names."""
    length = stress = None
    for word in (unit or "").split(",") if unit else ():
        if word.strip() in IN_MM:
            length = word.strip()
        else:
            look_up({**IN_MM, **IN_KPA}, word.strip(), "unit")
            stress = word.strip()
    return length, stress


def _directions(deck: Deck) -> tuple[np.ndarray | None, np.ndarray | None]:
    law = find_law(deck.material.law)
    if law.fibres and deck.fibres is None:
        raise InputError(
            f"line {deck.material.line}: law '{law.name}' needs fibres, and some elements have no "
            "direction"
        )
    return (deck.fibres if law.fibres else None), (deck.sheets if law.sheets else None)


def _scene(deck: Deck, path: Path, mesh_name: str, length: float, stress: float) -> str:
    """Return the entries of the scene file."""
    law = find_law(deck.material.law)
    head = [f'law = "{law.name}"', f"mesh = {quoted(mesh_name)}"]
    if deck.is_split:
        head += without_locking(deck.mesh)
    elif deck.mesh.order == 1:
        head.append("# order = 2   # quadratic elements, which do not lock")
    sections = ["\n".join(head)]
    for array, entries in (("supports", deck.supports), ("loads", deck.loads)):
        sections += [_table(array, scaled(part, length, stress)) for part in entries]
    constants = []
    source = f"{path.name}, line {deck.material.line}"
    for quantity in law.quantities:
        factor = stress if quantity.unit == "kPa" else 1.0
        value = factor * deck.material.values[quantity.name]
        if quantity.name in _CONSTANTS or value == 0.0:
            constants.append(f"{quantity.name} = {value!r}")
        else:
            sections.append(_parameter(quantity, value, source))
    if constants:
        sections.append("\n".join(["[constants]", *constants]))
    return "\n\n".join(sections)


def _parameter(quantity: Quantity, value: float, source: str) -> str:
    """Return the table of a parameter: a log-normal about a value, or a range between limits."""
    lines = [f"[parameters.{quantity.name}]"]
    lines += [f'unit = "{quantity.unit}"'] if quantity.unit else []
    if (quantity.low, quantity.high) == (0.0, math.inf):
        log_sd = LOG_SD if quantity.unit else LOG_SD_OF_NUMBERS
        words = f"{source}; no spread is known: log-sd {log_sd:g}"
        return "\n".join([*lines, f"median = {value!r}", f"log_sd = {log_sd:g}",
                          f"source = {quoted(words)}"])  # fmt: skip
    room = _TO_LIMIT * min(value - quantity.low, quantity.high - value)
    half = min(_HALF * abs(value), room)
    lines.append(f"range = [{value - half!r}, {value + half!r}]   # about {value!r}, {source}")
    return "\n".join(lines)


def scaled[Kind: Part](part: Kind, length: float, stress: float) -> Kind:
    """Return a load or a support of a deck in mm and kPa; factors are of the deck's units."""
    values: dict[str, Any] = {}
    for name, (of_stress, of_length) in _POWERS.items():
        value = vars(part).get(name)
        if value is not None:
            product = stress**of_stress * length**of_length * np.asarray(value, dtype=float)
            values[name] = tuple(product.tolist()) if isinstance(value, tuple) else (
                product if isinstance(value, np.ndarray) else float(product)
            )  # fmt: skip
    return replace(part, **values)


def _table(array: str, part: Part) -> str:
    """Return the table of a load or a support: its kind, and the fields that are not usual."""
    lines = [f"[[{array}]]", f'kind = "{part.kind}"']
    for field in fields(part):
        value = getattr(part, field.name)
        if value is not None and not _is_usual(field, value):
            lines.append(f"{field.name} = {_toml(value)}")
    return "\n".join(lines)


def _is_usual(field: Field, value: Any) -> bool:
    if field.default is not MISSING:
        return bool(np.array_equal(field.default, value))
    return field.default_factory is not MISSING and np.array_equal(field.default_factory(), value)


def _toml(value: Any) -> str:
    """Return a text, a number, or numbers in brackets."""
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, Sequence | np.ndarray):
        return json.dumps([float(x) + 0.0 for x in value])
    return repr(float(value) + 0.0)
