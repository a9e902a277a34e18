"""The content of a deck: mesh, material, directions, supports, loads, and what was not understood.

A deck has no units. Its numbers are kept as if lengths were in mm and stresses in kPa, so forces in
mN, until :mod:`.draft` multiplies them by the factors of the units that the user names.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emulator.core.errors import InputError, closest
from emulator.geometry.mesh import Mesh, coincident, find_rows, orient
from emulator.geometry.splitting import FACES, tetrahedra_of, triangles_of
from emulator.mechanics.laws import LAWS
from emulator.neighbours.decks.materials import Material
from emulator.scenes.loads import Force, Gravity
from emulator.scenes.loads.force import MN_PER_N
from emulator.scenes.part import BoundaryCondition, Load
from emulator.scenes.supports import Support

AXES = "xyz"
_STANDARD = 9.81  # m/s2 of the weight's acceleration; the density makes up for it
_KPA_PER_MM = 1.0e-3  # of 1 g/cm3 under 1 m/s2
_MOST_KEYS = 10_000_000  # numbers of one line of a set
_QUADRATIC, _QUADRILATERAL = 10, 4  # nodes of an element, and of a facet
_MOST_POINTS = 50  # nodes of one load, each of which gets a force by itself


@dataclass(frozen=True, eq=False)
class Deck:
    """The content of a deck, in its own units.

    Parameters
    ----------
    program : the program that the deck is for.
    mesh : the body and all its sets.
    material : the law and its parameters.
    supports, loads : those that the scene gets.
    fibres, sheets : unit vectors (m, 3), one an element, or None.
    is_split : whether elements of the deck were split into tetrahedra.
    unread : a sentence for each line that was not understood.
    notes : sentences on equations that differ.
    """

    program: str
    mesh: Mesh
    material: Material
    supports: tuple[BoundaryCondition, ...]
    loads: tuple[Load, ...]
    fibres: np.ndarray | None
    sheets: np.ndarray | None
    is_split: bool
    unread: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(eq=False)
class DeckFile:
    """A deck that is being read.

    path : its path.
    unread : each line that was not understood so far, and the words there.
    notes : sentences on equations that differ.
    """

    path: Path
    unread: list[tuple[int, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def error(self, line: int, problem: str) -> InputError:
        """Return ``problem`` as an error that names the deck and the line."""
        return InputError(f"deck {self.path}, line {line}: {problem}")

    def skip(self, line: int, text: str) -> None:
        """Keep a line that is not understood; its text is cut to what a comment may hold."""
        words = "".join(letter if letter.isprintable() else " " for letter in text).split()
        self.unread.append((line, " ".join(words)[:100]))

    def note(self, sentence: str) -> None:
        """Keep a sentence, once."""
        if sentence not in self.notes:
            self.notes.append(sentence)

    def numbers(
        self, words: str | Sequence[str], line: int, count: int | None = None
    ) -> list[float]:
        """Return the numbers of a text, which has ``count`` of them where that is not None."""
        values = []
        for word in words.replace(",", " ").split() if isinstance(words, str) else words:
            try:
                values.append(float(word))
            except ValueError:
                raise self.error(line, f"'{word[:40]}' is not a number") from None
        if count not in (None, len(values)) or not np.isfinite(values).all():
            raise self.error(line, f"{len(values)} numbers, expected {count or ''} finite ones")
        return values

    def keys(self, words: Sequence[str], line: int) -> list[int]:
        """Return whole numbers, such as the nodes of an element."""
        for word in words:
            if not word.strip().isdecimal():
                raise self.error(line, f"'{word.strip()[:40]}' is not the number of a node")
        return [int(word) for word in words]

    def span(self, words: Sequence[str], line: int) -> range:
        """Return the numbers from a first to a last one, by a step where there are three words."""
        first, last, step = [*self.keys(words, line), 1][:3] if len(words) > 1 else (0, 0, 0)
        if step < 1 or not 0 <= (last - first) // step < _MOST_KEYS:
            raise self.error(line, f"'{', '.join(words)[:40]}' are no numbers from, to, by")
        return range(first, last + 1, step)

    def unit(self, vector: np.ndarray, line: int) -> np.ndarray:
        """Return a direction (3,) of length one."""
        length = float(np.linalg.norm(vector))
        if length == 0.0:
            raise self.error(line, "a direction has length zero")
        return vector / length

    def known(self, name: str, sets: Iterable[str], noun: str, line: int) -> str:
        """Return ``name``, which must be one of the deck's sets or materials."""
        names = list(sets)
        if name not in names:
            there = ", ".join(names) or "none"
            hint = closest(name, names)
            raise self.error(line, f"{noun} '{name}' is not in the deck; it has {there}{hint}")
        return name

    def neighbour(self, name: str, line: int) -> Path:
        """Return the path of a file that the deck names; it lies in the deck's folder."""
        folder = self.path.resolve().parent
        path = (folder / name.strip()).resolve()
        if not path.is_relative_to(folder):
            raise self.error(line, f"'{name}' is outside of the deck's folder; copy it beside it")
        if not path.is_file():
            raise self.error(line, f"file '{name}' does not exist")
        return path


class Assembled(NamedTuple):
    """The mesh of a deck, and of each of its elements the row (m,) of the deck's element."""

    mesh: Mesh
    parents: np.ndarray


def finished(
    program: str, file: DeckFile, body: Assembled, material: Material,
    prescribed: Mapping[tuple[str, int], float], loads: Iterable[Load],
    axes: tuple[np.ndarray | None, np.ndarray | None], springs: Iterable[BoundaryCondition] = (),
) -> Deck:  # fmt: skip
    """Return a deck that was read; ``prescribed`` has displacements by node set and component."""
    values: dict[str, dict[int, float]] = {}
    for (name, axis), value in prescribed.items():
        values.setdefault(name, {})[axis] = value
    supports = (*(support(name, of_set) for name, of_set in values.items()), *springs)
    unread = tuple(f"line {line} is not understood: {text}" for line, text in sorted(file.unread))
    mesh, parents = body
    fibres, sheets = (None if rows is None else rows[parents] for rows in axes)
    is_split = len(np.unique(parents)) < len(parents)
    notes = tuple(file.notes)
    return Deck(
        program, mesh, material, supports, tuple(loads), fibres, sheets, is_split, unread, notes
    )


def read_text(path: Path) -> str:
    """Return the text of a deck that exists and is not empty."""
    if not path.is_file():
        raise InputError(f"deck {path} does not exist")
    text = path.read_text(encoding="utf-8", errors="replace")
    if not text.strip():
        raise InputError(f"deck {path} is empty")
    return text


class Element(NamedTuple):
    """The nodes of an element, and its line in the deck."""

    nodes: tuple[Any, ...]
    line: int


Row = tuple[Any, ...]
"""The corners of a facet, and its other nodes, by their numbers in the deck."""


def assemble[K: Hashable](
    file: DeckFile,
    nodes: Mapping[K, Sequence[float]],
    elements: Mapping[K, Element],
    node_sets: Mapping[str, Iterable[K]],
    facet_sets: Mapping[str, Sequence[Row]],
) -> Assembled:
    """Return the mesh; nodes of no element are dropped, other cells than tetrahedra are split.

    Parameters
    ----------
    nodes : coordinates by the deck's number.
    elements : tetrahedra of 10 nodes; or those of 4, prisms of 6 and hexahedra of 8 nodes.
    node_sets : the numbers of the nodes of each set.
    facet_sets : the corners of the facets of each set.
    """
    if not elements:
        raise InputError(f"deck {file.path}: it has no elements")
    are_linear = len(next(iter(elements.values())).nodes) < _QUADRATIC
    for number, (corners, line) in elements.items():
        if (len(corners) < _QUADRATIC) != are_linear:
            raise file.error(line, "linear and quadratic elements; expected one of the two")
        if absent := [k for k in corners if k not in nodes]:
            raise file.error(line, f"element {_shown(number)} has no node {_shown(absent[0])}")
    used = dict.fromkeys(k for element in elements.values() for k in element.nodes)
    places = {number: k for k, number in enumerate(k for k in nodes if k in used)}
    points = np.array([nodes[k] for k in places], dtype=float)
    split, parents = _tetrahedra([[places[k] for k in e.nodes] for e in elements.values()])
    rows = orient(points, split)
    kept = {name: [places[k] for k in keys if k in places] for name, keys in node_sets.items()}
    try:
        bare = Mesh(points, rows, {name: np.unique(k) for name, k in kept.items() if k})
        facets = {
            name: _on_surface(bare, name, corners, places)
            for name, corners in facet_sets.items()
            if len(corners)
        }
        mesh = Mesh(bare.nodes, bare.elements, bare.node_sets, facets)
    except InputError as error:
        reason = str(error).removeprefix("mesh: ")
        raise InputError(f"deck {file.path}: {reason}") from error
    if len(pairs := coincident(points)):
        one, other = (list(places)[k] for k in sorted(pairs[0]))
        raise InputError(
            f"deck {file.path}: nodes {_shown(one)} and {_shown(other)} are at the same place, "
            f"{len(pairs)} such pairs, so that what touches there is not joined; merge them"
        )
    return Assembled(mesh, parents)


def _tetrahedra(cells: Sequence[Sequence[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Return tetrahedra (t, 4 or 10), and the place (t,) among ``cells`` of the cell of each."""
    widths = np.array([len(cell) for cell in cells])
    rows, parents = [], []
    for width in np.unique(widths).tolist():
        numbers = np.flatnonzero(widths == width)
        of_width, of = np.array([cells[k] for k in numbers.tolist()]), np.arange(len(numbers))
        if width in FACES:
            of_width, of = tetrahedra_of(of_width)
        rows.append(of_width)
        parents.append(numbers[of])
    order = np.argsort(np.concatenate(parents), kind="stable")
    return np.concatenate(rows)[order], np.concatenate(parents)[order]


def _on_surface(
    mesh: Mesh, name: str, corners: Sequence[Row], places: Mapping[Any, int]
) -> np.ndarray:
    whole = [row for row in corners if len(row) != _QUADRILATERAL]
    fours = [row for row in corners if len(row) == _QUADRILATERAL]
    corners = [*whole, *(row for row in fours for _ in range(2))]
    numbers = np.array([[places.get(k, -1) for k in row] for row in fours], dtype=int)
    rows = np.array([[places.get(k, -1) for k in row[:3]] for row in whole], dtype=int)
    rows = np.concatenate([rows.reshape(-1, 3), triangles_of(numbers.reshape(-1, 4))])
    hits = find_rows(rows, mesh.surface[:, :3])
    if (hits < 0).any():
        row = ", ".join(map(_shown, corners[int(np.argmax(hits < 0))][:_QUADRILATERAL]))
        raise InputError(f"facet {row} of '{name}' is not on the surface of the body")
    return mesh.surface[np.unique(hits)]


def _shown(key: Hashable) -> str:
    """Return a number as the deck writes it, with the name of the instance where it has one."""
    return ".".join(str(k) for k in key if k != "") if isinstance(key, tuple) else str(key)


def support(name: str, values: Mapping[int, float]) -> Support:
    """Return the support that prescribes ``values`` of components 0 to 2 of a node set."""
    components = "".join(AXES[k] for k in sorted(values))
    return Support(name, np.array([values.get(k, 0.0) for k in range(3)]), components)


def weight(body_force: Sequence[float] | np.ndarray) -> list[Gravity]:
    """Return the load of a force per volume (3,), stress over length; none for no force."""
    size = float(np.linalg.norm(body_force))
    if size == 0.0:
        return []
    x, y, z = (float(component) / size for component in body_force)
    return [Gravity(size / (_KPA_PER_MM * _STANDARD), (x, y, z), _STANDARD)]


def point_forces[K: Hashable](
    file: DeckFile, line: int, node_sets: dict[str, list[K]], name: str, force: np.ndarray
) -> list[Force]:
    """Return a load for each node of a set, and add a set for it.

    A deck puts the whole force on each node of a set; here a set shares one force.
    """
    nodes = node_sets[name]
    if len(nodes) > _MOST_POINTS:
        file.skip(line, f"a force on each of the {len(nodes)} nodes of '{name}', which are many")
        return []
    sets = {f"{name} {k + 1}": [node] for k, node in enumerate(nodes)}
    node_sets |= sets
    return [Force(point, force / MN_PER_N) for point in sets]


def only_material(
    file: DeckFile, materials: Mapping[str, Material], used: Mapping[str, int]
) -> Material:
    """Return the material of the tetrahedra; refuse two that differ, and values out of range.

    used : the names of the materials that elements have, each with the line that says so.
    """
    if not used:
        raise InputError(f"deck {file.path}: its tetrahedra have no material")
    first, *others = (
        materials[file.known(name, materials, "material", line)] for name, line in used.items()
    )
    for other in others:
        if (other.law, other.values) != (first.law, first.values):
            what = f"other values of '{first.law}' than those"
            if other.law != first.law:
                what = f"'{other.law}', not '{first.law}' as that"
            raise file.error(
                other.line, f"a second material: {what} of line {first.line}; a scene has one"
            )
    if first.law not in LAWS:
        raise file.error(first.line, f"{first.law} is no law of this package")
    for quantity in LAWS[first.law].quantities:
        if fault := quantity.value_fault(first.values[quantity.name]):
            raise file.error(first.line, fault)
    if fault := first.fault():
        raise file.error(first.line, fault)
    for sentence in first.notes():
        file.note(sentence)
    return first
