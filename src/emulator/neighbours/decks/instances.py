"""Nodes, elements and sets of an Abaqus deck: flat, or of parts that an assembly places.

A set of a part is called by its instance's name and its own where there are several instances.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from emulator.geometry.file_formats import abaqus_face
from emulator.neighbours.decks.deck import DeckFile, Element, Row
from emulator.neighbours.decks.keywords import Block

WIDTHS = {"C3D4": 4, "C3D4H": 4, "C3D10": 10, "C3D10H": 10, "C3D10M": 10, "C3D10HS": 10,
          "C3D10MH": 10, "C3D6": 6, "C3D6H": 6, "C3D8": 8, "C3D8H": 8, "C3D8I": 8, "C3D8R": 8,
          "C3D8RH": 8}  # fmt: skip
Key = tuple[str, int]
"""The instance and the number of a node or an element; the instance of a flat deck is empty."""


@dataclass(eq=False)
class Scope:
    """The content of a part, of an instance, or of the assembly.

    part : the name of the part that an instance places, or empty.
    placement : the rows of an instance: translation, then two points and an angle.
    sets : members by the kind, NSET or ELSET, and the name in capitals: the instance that the
        block names, the word, and its line.
    faces : a set or an element, and its face, of each surface.
    """

    part: str = ""
    placement: list[tuple[int, list[str]]] = field(default_factory=list)
    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[int, Element] = field(default_factory=dict)
    sets: dict[tuple[str, str], list[tuple[str, str, int]]] = field(default_factory=dict)
    faces: dict[str, list[tuple[int, list[str]]]] = field(default_factory=dict)
    sections: list[Block] = field(default_factory=list)


class Instances:
    """All instances of a deck; their content is complete once all blocks were read."""

    def __init__(self, file: DeckFile) -> None:
        self.file = file
        self.parts: dict[str, Scope] = {}
        self.instances: dict[str, Scope] = {"": Scope()}
        self.names: dict[str, str] = {}
        self.current = self.instances[""]

    # Reading.

    def read(self, block: Block) -> bool:
        """Read a block of nodes, elements, sets or instances; say whether it is one."""
        name, keyword, scope = block.options.get("NAME", ""), block.keyword, self.current
        if keyword == "PART":
            self.current = self.parts[name.upper()] = Scope()
        elif keyword == "INSTANCE":
            part = block.options.get("PART", "").upper()
            self.file.known(part, self.parts, "part", block.line)
            self.names[name.upper()] = name
            self.current = self.instances[name.upper()] = Scope(part, [*block.numbered()])
        elif keyword in ("END PART", "END INSTANCE"):
            self.current = self.instances[""]
        elif keyword == "SOLID SECTION":
            scope.sections.append(block)
        elif keyword == "NODE":
            for line, row in block.numbered():
                key = self.file.keys(row[:1], line)[0]
                if key in scope.nodes:
                    raise self.file.error(line, f"node {key} is there before")
                xyz = self.file.numbers([word or "0" for word in row[1:4]], line)
                scope.nodes[key] = [*xyz, 0.0, 0.0, 0.0][:3]
            self._add("NSET", block.options.get("NSET", ""), block, [row[0] for row in block.rows])
        elif keyword == "ELEMENT":
            self._read_elements(block)
        elif keyword in ("NSET", "ELSET"):
            self._add(keyword, block.options.get(keyword, ""), block, self._members_in(block))
        elif keyword == "SURFACE" and block.options.get("TYPE", "ELEMENT").upper() == "NODE":
            self._add("NSET", name, block, [row[0] for row in block.rows])
        elif keyword == "SURFACE":
            self.names.setdefault(name.upper(), name)
            scope.faces.setdefault(name.upper(), []).extend(block.numbered())
        else:
            return False
        return True

    def _read_elements(self, block: Block) -> None:
        width = WIDTHS.get(kind := block.options.get("TYPE", "").upper())
        if width is None:
            raise self.file.error(
                block.line, f"elements '{kind}'; expected tetrahedra (C3D4 or C3D10), prisms "
                "(C3D6) or hexahedra (C3D8): mesh the volume with them",
            )  # fmt: skip
        words, numbers = list[str](), list[str]()
        for line, row in block.numbered():
            words += [word for word in row if word]
            if not row[-1] or len(words) < width + 1:
                continue  # goes on in the next row
            key, *nodes = self.file.keys(words, line)
            if len(nodes) != width or key in self.current.elements:
                what = f"{len(nodes)} nodes" if len(nodes) != width else "it is there before"
                raise self.file.error(line, f"element {key} of type {kind}: {what}")
            self.current.elements[key] = Element(tuple(nodes), line)
            numbers.append(str(key))
            words = []
        if words:
            raise self.file.error(block.lines[-1], f"{len(words) - 1} nodes of a {kind}")
        self._add("ELSET", block.options.get("ELSET", ""), block, numbers)

    def _members_in(self, block: Block) -> list[str]:
        if "GENERATE" not in block.options:
            return block.words()
        members = list[str]()
        for line, row in block.numbered():
            words = [word for word in row if word]
            members += map(str, self.file.span(words, line))
        return members

    def _add(self, kind: str, name: str, block: Block, members: Iterable[str]) -> None:
        if name:
            self.names.setdefault(name.upper(), name)
            owner = block.options.get("INSTANCE", "").upper()
            rows = self.current.sets.setdefault((kind, name.upper()), [])
            rows += [(owner, member, block.line) for member in members]

    # Content.

    def scopes(self) -> Iterator[tuple[str, Scope]]:
        """Yield each instance's name and the scopes that its content is in."""
        for name, scope in self.instances.items():
            if scope.part:
                yield name, self.parts[scope.part]
            yield name, scope

    @cached_property
    def sections(self) -> list[Block]:
        """The solid sections of all instances."""
        return [section for _, scope in self.scopes() for section in scope.sections]

    @cached_property
    def nodes(self) -> dict[Key, list[float]]:
        """Coordinates of all nodes, each instance at its place."""
        nodes: dict[Key, list[float]] = {}
        for name, scope in self.scopes():
            turn, shift = self.motion(name)
            points = np.reshape([*scope.nodes.values()], (-1, 3)) @ turn.T + shift
            nodes |= {(name, k): x for k, x in zip(scope.nodes, points.tolist(), strict=True)}
        return nodes

    @cached_property
    def elements(self) -> dict[Key, Element]:
        """All elements, of nodes of their instances."""
        return {
            (name, k): element._replace(nodes=tuple((name, node) for node in element.nodes))
            for name, scope in self.scopes()
            for k, element in scope.elements.items()
        }

    @cached_property
    def node_sets(self) -> dict[str, list[Key]]:
        """The nodes of each set, by its name in the scene."""
        return {
            self.label(owner, name): self.members("NSET", owner, name)
            for owner, scope in self.scopes()
            for kind, name in scope.sets
            if kind == "NSET"
        }

    @cached_property
    def facet_sets(self) -> dict[str, list[Row]]:
        """The corners of the facets of each surface, by its name in the scene."""
        return {
            self.label(owner, name): self.facets(owner, rows)
            for owner, scope in self.scopes()
            for name, rows in scope.faces.items()
        }

    def label(self, owner: str, name: str) -> str:
        """Return the name of a set in the scene."""
        shown = self.names.get(name, name)
        # Besides the assembly there is one instance: its name says nothing.
        return f"{self.names[owner]}.{shown}" if owner and len(self.instances) > 2 else shown

    def motion(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation matrix and the shift of an instance: it is moved, then turned."""
        placement = self.instances[name].placement
        rows = [self.file.numbers([word for word in row if word], line) for line, row in placement]
        shift = np.array([*rows[0], 0.0, 0.0, 0.0][:3]) if rows else np.zeros(3)
        if len(rows) < 2:
            return np.eye(3), shift
        if len(rows[1]) != 7:
            raise self.file.error(placement[1][0], "a rotation is two points and an angle")
        a, b = np.reshape(rows[1][:6], (2, 3))
        x, y, z = self.file.unit(b - a, placement[1][0])
        cross, angle = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), np.deg2rad(rows[1][6])
        turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        return turn, turn @ (shift - a) + a

    def members(self, kind: str, owner: str, name: str, outer: tuple[str, ...] = ()) -> list[Key]:
        """Return the nodes or elements of a set of an instance, those of sets within it included.

        outer : the sets that it is in.
        """
        known, noun = (self.nodes, "node") if kind == "NSET" else (self.elements, "element")
        members: list[Key] = []
        rows = (scope.sets.get((kind, name), ()) for of, scope in self.scopes() if of == owner)
        for instance, word, line in (row for of_scope in rows for row in of_scope):
            where, _, label = word.upper().rpartition(".")
            where = where or instance or owner
            inside = [(where, int(label))] if label.isdecimal() else []
            if not label.isdecimal() and (where, label) != (owner, name) and name not in outer:
                inside = self.members(kind, where, label, (*outer, name))
            if not inside or not set(inside) <= set(known):
                raise self.file.error(line, f"set '{name}': there is no {noun} or set {word}")
            members += inside
        return members

    def elements_of(self, owner: str, word: str, line: int) -> list[Key]:
        """Return the elements that a word names: a set, or one element."""
        where, _, label = word.upper().rpartition(".")
        key = (where or owner, int(label) if label.isdecimal() else -1)
        members = [key] if key in self.elements else self.members("ELSET", key[0], label)
        if not members:
            raise self.file.error(line, f"element set '{word}' is not in the deck")
        return members

    def facets(self, owner: str, rows: Iterable[tuple[int, list[str]]]) -> list[Row]:
        """Return the corners of faces S1, S2, ... of elements."""
        facets: list[Row] = []
        for line, row in rows:
            word, of_row = row[1] if len(row) > 1 else "", list[Row]()
            for key in self.elements_of(owner, row[0], line):
                nodes = self.elements[key].nodes
                of_row.append(tuple(nodes[c] for c in abaqus_face(word, len(nodes))))
            if not all(of_row):
                self.file.skip(line, f"{', '.join(row)} of a surface, no face of a solid")
                continue
            facets += of_row
        return facets

    def surface(self, word: str, line: int) -> str:
        """Return the scene's name of a surface."""
        return self._named(word, self.facet_sets, "surface", line)

    def node_set(self, word: str, line: int) -> str:
        """Return the scene's name of a node set, made for one node where a word is its number."""
        where, _, label = word.upper().rpartition(".")
        if label.isdecimal() and (where, int(label)) in self.nodes:
            self.node_sets[name := f"node {word}"] = [(where, int(label))]
            return name
        return self._named(word, self.node_sets, "node set", line)

    def _named(self, word: str, sets: dict[str, list], noun: str, line: int) -> str:
        where, _, label = word.upper().rpartition(".")
        owners = [owner for owner in self.instances if not where or owner == where]
        names = (self.label(owner, label) for owner in owners)
        name = next((name for name in names if name in sets), word)
        return self.file.known(name, sets, noun, line)
