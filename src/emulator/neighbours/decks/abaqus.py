"""Input files of Abaqus and CalculiX, flat or of parts and instances.

The state at the end of the last step is read: later conditions replace earlier ones of the same set
and component. A pressure follows the surface with ``NLGEOM`` and keeps its direction without.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.file_formats import ABAQUS_FACES
from emulator.neighbours.decks import materials
from emulator.neighbours.decks.deck import (
    Deck,
    DeckFile,
    Element,
    Row,
    assemble,
    only_material,
    point_forces,
    support,
    weight,
)
from emulator.neighbours.decks.keywords import Block, read_blocks
from emulator.neighbours.decks.materials import Material
from emulator.scenes.loads import DeadPressure, FollowerPressure, Traction
from emulator.scenes.part import Load

_WIDTHS = {"C3D4": 4, "C3D4H": 4, "C3D10": 10, "C3D10H": 10, "C3D10M": 10, "C3D10HS": 10,
           "C3D10MH": 10}  # fmt: skip
_FIXED = {
    "ENCASTRE": (0, 1, 2), "PINNED": (0, 1, 2),
    "XSYMM": (0,), "YSYMM": (1,), "ZSYMM": (2,),
}  # fmt: skip
_SETTINGS = {
    "HEADING", "PREPRINT", "PART", "END PART", "ASSEMBLY", "END ASSEMBLY", "INSTANCE",
    "END INSTANCE", "STEP", "END STEP", "STATIC", "OUTPUT", "NODE OUTPUT", "ELEMENT OUTPUT",
    "NODE PRINT", "EL PRINT", "NODE FILE", "EL FILE", "CONTACT OUTPUT", "RESTART", "MATERIAL",
    "FILE FORMAT", "DISTRIBUTION TABLE", "ENERGY OUTPUT", "SECTION CONTROLS",
}  # fmt: skip
_QUADRATIC = "kappa/2 (J - 1)^2"
Key = tuple[str, int]
"""The instance and the number of a node or an element."""


@dataclass(eq=False)
class Scope:
    """The nodes, elements and sets of a part, of an instance, or of the assembly.

    sets : members by the kind, NSET or ELSET, and the name in capitals.
    faces : the rows of each surface: a set or an element, and its face.
    rows : the instance's translation and rotation.
    """

    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[int, Element] = field(default_factory=dict)
    sets: dict[tuple[str, str], list[tuple[str, str, int]]] = field(default_factory=dict)
    faces: dict[str, list[tuple[int, list[str]]]] = field(default_factory=dict)
    sections: list[Block] = field(default_factory=list)
    part: str = ""
    placement: list[tuple[int, list[str]]] = field(default_factory=list)


def read_abaqus(file: DeckFile) -> Deck:
    """Return the content of an input file."""
    return _Reading(file, read_blocks(file)).deck()


class _Reading:
    """The tables of a deck that is being read.

    parts, instances : scopes by their names in capitals; the assembly, or a flat deck, is the
        instance "".
    """

    def __init__(self, file: DeckFile, blocks: list[Block]) -> None:
        self.file, self.blocks = file, blocks
        self.parts: dict[str, Scope] = {}
        self.instances: dict[str, Scope] = {"": Scope()}
        self.names: dict[str, str] = {}
        self.library: dict[str, list[Block]] = {}
        self.tables: dict[str, Block] = {}
        self.steps = [b for b in blocks if b.keyword == "STEP"]
        self.finite = any(b.options.get("NLGEOM", "NO") != "NO" for b in self.steps)
        self.period = 1.0
        self.nodes: dict[Key, list[float]] = {}
        self.elements: dict[Key, Element] = {}
        self.node_sets: dict[str, list[Key]] = {}
        self.facet_sets: dict[str, list[Row]] = {}
        self.prescribed: dict[tuple[str, int], float] = {}
        self.loads: list[Load] = []

    def deck(self) -> Deck:
        """Return the content."""
        self._read_blocks()
        self._place()
        sections = [(name, s) for name, scope in self._scopes() for s in scope.sections]
        used = {s.options.get("MATERIAL", "").upper(): s.line for _, s in sections}
        library = {
            name: self._material(name, rows) for name, rows in self.library.items() if name in used
        }
        material = only_material(self.file, library, used)
        readers = {"BOUNDARY": self._read_boundary, "CLOAD": self._read_forces}
        for block in self.blocks:
            if block.options.get("OP", "MOD").upper() == "NEW" and len(self.steps) > 1:
                self.file.skip(block.line, f"{block.described()}: earlier ones are kept")
            if block.keyword in readers:
                readers[block.keyword](block)
            elif block.keyword in ("DLOAD", "DSLOAD"):
                self._read_distributed(block, material.density)
        mesh = assemble(self.file, self.nodes, self.elements, self.node_sets, self.facet_sets)
        fibres, sheets = self._axes(sections)
        values: dict[str, dict[int, float]] = {}
        for (name, axis), value in self.prescribed.items():
            values.setdefault(name, {})[axis] = value
        supports = tuple(support(name, of_set) for name, of_set in values.items())
        for sentence in material.notes():
            self.file.note(sentence)
        return Deck(
            "Abaqus", mesh, material, supports, tuple(self.loads), fibres, sheets,
            tuple(self.file.unread), tuple(self.file.notes),
        )  # fmt: skip

    # Blocks.

    def _read_blocks(self) -> None:
        scope, owner = self.instances[""], ""
        loads = {"BOUNDARY", "CLOAD", "DLOAD", "DSLOAD"}
        for block in self.blocks:
            name = block.options.get("NAME", "")
            if block.keyword == "PART":
                scope = self.parts[name.upper()] = Scope()
            elif block.keyword == "INSTANCE":
                scope = self.instances[name.upper()] = Scope(
                    part=block.options.get("PART", "").upper(), placement=[*block.numbered()]
                )
                self.names[name.upper()] = name
            elif block.keyword in ("END PART", "END INSTANCE"):
                scope = self.instances[""]
            elif block.keyword == "MATERIAL":
                owner = name.upper()
                self.library[owner] = []
            elif block.keyword in ("HYPERELASTIC", "ANISOTROPIC HYPERELASTIC", "ELASTIC"):
                self.library.setdefault(owner, []).append(block)
            elif block.keyword == "DENSITY":
                self.library.setdefault(owner, []).append(block)
            elif block.keyword == "SOLID SECTION":
                scope.sections.append(block)
            elif block.keyword in ("AMPLITUDE", "ORIENTATION", "DISTRIBUTION"):
                self.tables[f"{block.keyword} {name.upper()}"] = block
            elif block.keyword == "STATIC" and block.rows and len(block.rows[0]) > 1:
                self.period = self.file.numbers(block.rows[0][1:2], block.lines[0], 1)[0]
            elif not self._read_of_scope(scope, block) and block.keyword not in _SETTINGS | loads:
                self.file.skip(block.line, block.described())

    def _read_of_scope(self, scope: Scope, block: Block) -> bool:
        """Read nodes, elements or a set into a scope; say whether the block is one of these."""
        if block.keyword == "NODE":
            for line, row in block.numbered():
                number = self.file.keys(row[:1], line)[0]
                if number in scope.nodes:
                    raise self.file.error(line, f"node {number} is there before")
                xyz = self.file.numbers([word or "0" for word in row[1:4]], line)
                scope.nodes[number] = [*xyz, 0.0, 0.0, 0.0][:3]
            self._add(scope, "NSET", block.options.get("NSET", ""), block, [r[0] for r in block.rows])
        elif block.keyword == "ELEMENT":
            self._read_elements(scope, block)
        elif block.keyword in ("NSET", "ELSET"):
            members = block.words()
            if "GENERATE" in block.options:
                members = []
                for line, row in block.numbered():
                    first, last, *step = self.file.keys([word for word in row if word], line)
                    every = range(first, last + 1, max(1, *step, 1) if step else 1)
                    members += [str(k) for k in every]
            self._add(scope, block.keyword, block.options.get(block.keyword, ""), block, members)
        elif block.keyword == "SURFACE":
            name = block.options.get("NAME", "")
            if block.options.get("TYPE", "ELEMENT").upper() == "NODE":
                self._add(scope, "NSET", name, block, [row[0] for row in block.rows])
            else:
                self.names.setdefault(name.upper(), name)
                scope.faces.setdefault(name.upper(), []).extend(block.numbered())
        else:
            return False
        return True

    def _read_elements(self, scope: Scope, block: Block) -> None:
        kind = block.options.get("TYPE", "").upper()
        if kind not in _WIDTHS:
            raise self.file.error(
                block.line, f"elements '{kind}'; expected tetrahedra only (C3D4 or C3D10): mesh or "
                "split the volume into them",
            )  # fmt: skip
        words: list[str] = []
        numbers = []
        for line, row in block.numbered():
            words += [word for word in row if word]
            if len(words) > _WIDTHS[kind]:
                number, *nodes = self.file.keys(words, line)
                if len(nodes) != _WIDTHS[kind]:
                    raise self.file.error(line, f"{len(nodes)} nodes of a {kind}")
                if number in scope.elements:
                    raise self.file.error(line, f"element {number} is there before")
                scope.elements[number] = Element(tuple(nodes), line)
                numbers.append(str(number))
                words = []
        if words:
            raise self.file.error(block.lines[-1], f"{len(words) - 1} nodes of a {kind}")
        self._add(scope, "ELSET", block.options.get("ELSET", ""), block, numbers)

    def _add(self, scope: Scope, kind: str, name: str, block: Block, members: list[str]) -> None:
        """Append members to a set; each has the instance that the block names."""
        if name:
            self.names.setdefault(name.upper(), name)
            owner = block.options.get("INSTANCE", "").upper()
            rows = scope.sets.setdefault((kind, name.upper()), [])
            rows += [(owner, member, block.line) for member in members]

    # Instances.

    def _scopes(self) -> Iterator[tuple[str, Scope]]:
        """Yield each instance's name and the scopes that its content is in."""
        for name, scope in self.instances.items():
            if scope.part:
                yield name, self.parts[scope.part]
            yield name, scope

    def _place(self) -> None:
        """Collect nodes, elements and sets of all instances, each placed."""
        for scope in self.instances.values():
            if scope.part and scope.part not in self.parts:
                raise InputError(f"deck {self.file.path}: part '{scope.part}' is not in the deck")
        for name, scope in self._scopes():
            moved = self._motion(self.instances[name].placement)
            points = np.reshape([*scope.nodes.values()], (-1, 3)) @ moved[0].T + moved[1]
            self.nodes |= {(name, k): x for k, x in zip(scope.nodes, points.tolist(), strict=True)}
            for k, element in scope.elements.items():
                corners = tuple((name, node) for node in element.nodes)
                self.elements[name, k] = element._replace(nodes=corners)
        single = len([name for name in self.instances if name]) == 1
        for name, scope in self._scopes():
            for kind, label in scope.sets:
                if kind == "NSET":
                    self.node_sets[self._label(name, label, single)] = self._members(
                        "NSET", name, label
                    )
            for label, rows in scope.faces.items():
                full = self._label(name, label, single)
                self.facet_sets.setdefault(full, []).extend(self._facets(name, rows))
        self.single = single

    def _label(self, owner: str, name: str, single: bool) -> str:
        """Return the name of a set in the scene: with its instance, if there are several."""
        shown = self.names.get(name, name)
        return shown if not owner or single else f"{self.names.get(owner, owner)}.{shown}"

    def _motion(self, rows: list[tuple[int, list[str]]]) -> tuple[np.ndarray, np.ndarray]:
        """Return the matrix and the shift of an instance: translation first, then rotation."""
        values = [self.file.numbers([w for w in row if w], line) for line, row in rows]
        shift = np.array([*values[0], 0.0, 0.0, 0.0][:3]) if values else np.zeros(3)
        if len(values) < 2:
            return np.eye(3), shift
        if len(values[1]) != 7:
            raise self.file.error(rows[1][0], "a rotation has two points and an angle, 7 numbers")
        a, axis, angle = np.array(values[1][:3]), np.array(values[1][3:6]), values[1][6]
        x, y, z = axis = (axis - a) / np.linalg.norm(axis - a)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = np.deg2rad(angle)
        matrix = np.eye(3) + np.sin(turn) * cross + (1.0 - np.cos(turn)) * cross @ cross
        return matrix, matrix @ (shift - a) + a

    def _members(self, kind: str, owner: str, name: str) -> list[Key]:
        """Return the nodes or elements of a set of an instance, sets within it included."""
        scopes = [scope for instance, scope in self._scopes() if instance == owner]
        members: list[Key] = []
        known = self.nodes if kind == "NSET" else self.elements
        for instance, word, line in (
            row for scope in scopes for row in scope.sets.get((kind, name), ())
        ):
            where, _, label = word.upper().rpartition(".")
            where = where or instance or owner
            if where not in self.instances:
                raise self.file.error(line, f"instance '{where}' is not in the deck")
            if label.isdigit():
                if (where, int(label)) not in known:
                    noun = "node" if kind == "NSET" else "element"
                    raise self.file.error(line, f"set '{name}' has {noun} {label}, which does not exist")
                members.append((where, int(label)))
            elif label == name and where == owner:
                raise self.file.error(line, f"set '{name}' contains itself")
            elif not (inside := self._members(kind, where, label)):
                raise self.file.error(line, f"set '{word}' in '{name}' is not in the deck")
            else:
                members += inside
        return members

    def _elements_of(self, owner: str, word: str, line: int) -> list[Key]:
        """Return the elements that a word names: a set, or one element."""
        where, _, label = word.upper().rpartition(".")
        where = where or owner
        if label.isdigit():
            return [(where, int(label))] if (where, int(label)) in self.elements else []
        members = self._members("ELSET", where, label) if where in self.instances else []
        if not members:
            raise self.file.error(line, f"element set '{word}' is not in the deck")
        return members

    def _facets(self, owner: str, rows: list[tuple[int, list[str]]]) -> list[Row]:
        facets: list[Row] = []
        for line, row in rows:
            face = row[1].upper() if len(row) > 1 else ""
            if face not in ABAQUS_FACES:
                self.file.skip(line, f"{', '.join(row)} of a surface, no face S1 to S4")
                continue
            for key in self._elements_of(owner, row[0], line):
                nodes = self.elements[key].nodes
                facets.append(tuple(nodes[c] for c in ABAQUS_FACES[face]))
        return facets

    def _set(self, word: str, sets: dict[str, list], noun: str, line: int) -> str:
        """Return the scene's name of a set that a load or a support names."""
        where, _, label = word.upper().rpartition(".")
        names = (self._label(owner, label, self.single) for owner in ([where] if where else ["", *self.instances]))
        return next((n for n in names if n in sets), None) or self.file.known(word, sets, noun, line)

    def _nodes(self, word: str, line: int) -> str:
        """Return the name of a node set, made for one node where the word is its number."""
        where, _, label = word.upper().rpartition(".")
        if not label.isdigit():
            return self._set(word, self.node_sets, "node set", line)
        if (where, int(label)) not in self.nodes:
            raise self.file.error(line, f"node {word} does not exist")
        self.node_sets[name := f"node {word}"] = [(where, int(label))]
        return name

    # Material.

    def _material(self, name: str, blocks: list[Block]) -> Material:
        density = None
        chosen: tuple[str, dict[str, float], int, str] | None = None
        for block in blocks:
            line = block.lines[0] if block.lines else block.line
            values = self.file.numbers(block.words(), line)
            if block.keyword == "DENSITY":
                density = values[0]
            elif block.keyword == "ELASTIC":
                if self.finite or len(values) != 2 or block.options.get("TYPE", "ISO")[:3] != "ISO":
                    raise self.file.error(
                        block.line, "*Elastic is a law here without NLGEOM, of E and nu, only"
                    )
                law = "small_strain_E_nu", dict(zip(("E", "nu"), values, strict=True))
                chosen = (*law, block.line, "")
            else:
                isotropic = block.keyword == "HYPERELASTIC"
                law = (self._isotropic if isotropic else self._families)(block, values)
                chosen = (*law, block.line, _QUADRATIC if isotropic else "")
                if not self.finite and self.steps:
                    self.file.note("the deck's step has no NLGEOM; the scene has finite strains")
        if chosen is None:
            raise InputError(f"deck {self.file.path}: material '{name}' has no *Hyperelastic")
        return Material(chosen[0], chosen[1], chosen[2], density, chosen[3])

    def _isotropic(self, block: Block, values: list[float]) -> tuple[str, dict[str, float]]:
        order = int(block.options.get("N", "1") or 1)
        options = " ".join(block.options)
        if "NEO HOOKE" in options or ("REDUCED POLYNOMIAL" in options and order == 1):
            (c_10,), kappa = self._split(block, values, 1, 1)
            return "neo_hookean_split", {"mu": 2.0 * c_10, "kappa": kappa}
        if "MOONEY" in options or ("POLYNOMIAL" in options and "RED" not in options and order == 1):
            (c_10, c_01), kappa = self._split(block, values, 2, 1)
            return "mooney_rivlin", {"c_10": c_10, "c_01": c_01, "kappa": kappa}
        if "YEOH" in options or ("REDUCED POLYNOMIAL" in options and order == 3):
            c, kappa = self._split(block, values, 3, 3)
            return "yeoh", {f"c_{k}": x for k, x in enumerate(c, start=1)} | {"kappa": kappa}
        if "OGDEN" in options:
            terms, kappa = self._split(block, values, 2 * order, order)
            if law := materials.ogden(terms[::2], terms[1::2], kappa):
                return law
        raise self.file.error(
            block.line, f"{block.described()} is no law of this package; it reads Neo Hooke, "
            "Mooney-Rivlin, Yeoh and Ogden of up to 3 terms",
        )  # fmt: skip

    def _split(
        self, block: Block, values: list[float], count: int, bulks: int
    ) -> tuple[list[float], float]:
        """Return shape parameters and the bulk modulus 2 / D1."""
        shape, bulk = values[:count], values[count : count + bulks]
        if len(shape) < count or len(values) > count + bulks + 1:
            raise self.file.error(block.line, f"{block.described()}: {len(values)} constants")
        if not bulk or bulk[0] <= 0.0:
            raise self.file.error(
                block.line, "D1 is 0: the material is incompressible, as no law here is; give D1, "
                "2 over a bulk modulus of some hundred times the shear modulus",
            )  # fmt: skip
        if any(bulk[1:]):
            self.file.skip(block.line, f"{block.described()}: D2 and D3, which are not 0")
        return shape, 2.0 / bulk[0]

    def _families(self, block: Block, values: list[float]) -> tuple[str, dict[str, float]]:
        if "HOLZAPFEL" not in block.options or block.options.get("LOCAL DIRECTIONS") != "2":
            raise self.file.error(
                block.line, f"{block.described()}; expected Holzapfel with LOCAL DIRECTIONS=2"
            )
        if len(values) < 4 or values[1] <= 0.0:
            raise self.file.error(block.line, "expected C10, D above 0, k1, k2, kappa")
        c_10, d, k_1, k_2, dispersion = [*values, 0.0][:5]
        angle = 0.5 * np.degrees(np.arccos(np.prod(self._directions(block), axis=0).sum()))
        return materials.fibre_families(2.0 * c_10, k_1, k_2, float(angle), dispersion, 2.0 / d)

    # Directions.

    def _directions(self, block: Block) -> np.ndarray:
        """Return the two local directions (2, 3) of fibres, in the axes of the orientation."""
        names = {s.options.get("ORIENTATION", "").upper()
                 for _, scope in self._scopes() for s in scope.sections}  # fmt: skip
        tables = [self.tables.get(f"ORIENTATION {name}") for name in names]
        if len(tables) != 1 or (table := tables[0]) is None:
            raise self.file.error(block.line, "its solid section names no *Orientation, or several")
        count = int(table.options.get("LOCAL DIRECTIONS", "0") or 0)
        if count == 0:  # the first two axes
            raise self.file.error(table.line, "expected LOCAL DIRECTIONS=2 and their lines")
        rows = [self.file.numbers(row[:3], line, 3) for line, row in [*table.numbered()][-count:]]
        unit = np.array(rows) / np.linalg.norm(rows, axis=1, keepdims=True)
        if len(unit) != 2 or abs(unit[0] @ unit[1]) > 1.0 - 1e-12:
            raise self.file.error(table.line, "expected 2 local directions that differ")
        return unit

    def _axes(
        self, sections: list[tuple[str, Block]]
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return the bisectors of the two families of fibres in each element."""
        name = sections[0][1].options.get("ORIENTATION", "").upper() if sections else ""
        table = self.tables.get(f"ORIENTATION {name}")
        if table is None or "LOCAL DIRECTIONS" not in table.options:
            return None, None
        if table.options.get("SYSTEM", "RECTANGULAR").upper() != "RECTANGULAR" or not table.rows:
            raise self.file.error(table.line, f"{table.described()}; expected rectangular axes")
        first, second = self._directions(table)
        bisectors = np.array([first + second, first - second])
        bisectors /= np.linalg.norm(bisectors, axis=1, keepdims=True)
        rows = {None: self._frame(table.rows[0], table.lines[0])} if len(table.rows[0]) > 3 else {}
        if not rows:
            data = self.tables.get(f"DISTRIBUTION {table.rows[0][0].upper()}")
            if data is None:
                raise self.file.error(table.lines[0], f"distribution '{table.rows[0][0]}' is not there")
            rows = {
                int(row[0]) if row[0] else None: self._frame(row[1:], line)
                for line, row in data.numbered()
            }
        frames = [rows.get(number, rows.get(None)) for _, number in self.elements]
        if any(frame is None for frame in frames):
            raise self.file.error(table.line, "some elements have no orientation")
        turns = [self._motion(self.instances[owner].placement)[0] for owner, _ in self.elements]
        axes = np.einsum("mij,mkj,dk->dmi", np.array(turns), np.array(frames), bisectors)
        return axes[0], axes[1]

    def _frame(self, words: list[str], line: int) -> np.ndarray:
        """Return local axes, the columns of (3, 3), from points a on x and b on the plane x, y."""
        a, b = np.reshape(self.file.numbers([w for w in words if w][:6], line, 6), (2, 3))
        x, z = a / np.linalg.norm(a), np.cross(a, b)
        z /= np.linalg.norm(z)
        return np.column_stack([x, np.cross(z, x), z])

    # Supports and loads.

    def _amplitude(self, block: Block) -> float:
        """Return the amplitude of a block at the end of the last step."""
        name = block.options.get("AMPLITUDE")
        if name is None:
            return 1.0
        table = self.tables.get(f"AMPLITUDE {name.upper()}")
        if table is None:
            raise self.file.error(block.line, f"amplitude '{name}' is not in the deck")
        pairs = np.reshape(self.file.numbers(table.words(), table.line), (-1, 2))
        return float(np.interp(self.period, pairs[:, 0], pairs[:, 1]))

    def _read_boundary(self, block: Block) -> None:
        kind = block.options.get("TYPE", "DISPLACEMENT").upper()
        if kind != "DISPLACEMENT" or {"USER", "SUBMODEL"} & set(block.options):
            self.file.skip(block.line, block.described())
            return
        scale = self._amplitude(block)
        for line, row in block.numbered():
            name = self._nodes(row[0], line)
            word = row[1].upper() if len(row) > 1 else ""
            if word in _FIXED:
                self.prescribed |= {(name, axis): 0.0 for axis in _FIXED[word]}
                continue
            first = self.file.keys(row[1:2], line)[0] if word else 0
            last = self.file.keys(row[2:3], line)[0] if len(row) > 2 and row[2] else first
            value = self.file.numbers(row[3:4], line)[0] if len(row) > 3 and row[3] else 0.0
            axes = [k - 1 for k in range(first, last + 1) if 1 <= k <= 3]
            if not axes:
                self.file.skip(line, ", ".join(row))
            self.prescribed |= {(name, axis): scale * value for axis in axes}

    def _read_forces(self, block: Block) -> None:
        scale = self._amplitude(block)
        for line, row in block.numbered():
            name = self._nodes(row[0], line)
            component = self.file.keys(row[1:2], line)[0] - 1
            if not 0 <= component <= 2 or "FOLLOWER" in block.options:
                self.file.skip(line, ", ".join(row))
                continue
            force = scale * self.file.numbers(row[2:3], line, 1)[0] * np.eye(3)[component]
            keys = self.node_sets[name]
            for key, (point, load) in zip(
                keys, point_forces(self.file, line, name, len(keys), force), strict=False
            ):
                self.node_sets[point] = [key]
                self.loads.append(load)

    def _read_distributed(self, block: Block, density: float | None) -> None:
        scale = self._amplitude(block)
        for line, row in block.numbered():
            kind = row[1].upper() if len(row) > 1 else ""
            load: Load | None = None
            if kind == "GRAV" and density is not None and self._is_body(row[0], line):
                size, *direction = self.file.numbers(row[2:6], line, 4)
                load = weight([scale * density * size * x for x in direction])
            elif kind in ("BX", "BY", "BZ") and self._is_body(row[0], line):
                size = scale * self.file.numbers(row[2:3], line, 1)[0]
                load = weight([size * float(kind[1] == axis) for axis in "XYZ"])
            elif block.keyword == "DLOAD" and f"S{kind[1:]}" in ABAQUS_FACES and kind[0] == "P":
                name = f"{row[0]} {kind}"
                self.facet_sets[name] = self._facets("", [(line, [row[0], f"S{kind[1:]}"])])
                load = self._pressure(name, scale * self.file.numbers(row[2:3], line, 1)[0])
            elif block.keyword == "DSLOAD" and kind == "P":
                name = self._set(row[0], self.facet_sets, "surface", line)
                load = self._pressure(name, scale * self.file.numbers(row[2:3], line, 1)[0])
            elif kind == "TRVEC" and block.options.get("FOLLOWER", "YES").upper() == "NO":
                name = self._set(row[0], self.facet_sets, "surface", line)
                size, *direction = self.file.numbers(row[2:6], line, 4)
                vector = scale * size * np.array(direction) / np.linalg.norm(direction)
                load = Traction(name, (float(vector[0]), float(vector[1]), float(vector[2])))
            if load is None:
                self.file.skip(line, ", ".join(row))
            else:
                self.loads.append(load)

    def _pressure(self, name: str, value: float) -> Load:
        return (FollowerPressure if self.finite else DeadPressure)(name, value)

    def _is_body(self, word: str, line: int) -> bool:
        """Say whether a word names all elements; no word does."""
        return not word or len({*self._elements_of("", word, line)}) == len(self.elements)
