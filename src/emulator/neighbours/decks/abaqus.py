"""Input files of Abaqus and CalculiX, flat or of parts and instances.

The state at the end of the last step is read: later conditions replace earlier ones of the same set
and component. A pressure follows the surface with ``NLGEOM`` and keeps its direction without.
"""

from __future__ import annotations

import numpy as np

from emulator.core.errors import InputError
from emulator.mechanics.laws import find_law
from emulator.neighbours.decks import materials
from emulator.neighbours.decks.deck import (
    Deck,
    DeckFile,
    assemble,
    finished,
    only_material,
    point_forces,
    weight,
)
from emulator.neighbours.decks.instances import Instances
from emulator.neighbours.decks.keywords import Block, read_blocks
from emulator.neighbours.decks.materials import Material, Parameters
from emulator.scenes.loads import DeadPressure, FollowerPressure, Traction
from emulator.scenes.part import Load

_FIXED = {
    "ENCASTRE": (0, 1, 2), "PINNED": (0, 1, 2),
    "XSYMM": (0,), "YSYMM": (1,), "ZSYMM": (2,),
}  # fmt: skip
_SETTINGS = {
    "HEADING", "PREPRINT", "ASSEMBLY", "END ASSEMBLY", "STEP", "END STEP", "STATIC", "OUTPUT",
    "NODE OUTPUT", "ELEMENT OUTPUT", "NODE PRINT", "EL PRINT", "NODE FILE", "EL FILE", "RESTART",
    "CONTACT OUTPUT", "ENERGY OUTPUT", "FILE FORMAT", "DISTRIBUTION TABLE", "SECTION CONTROLS",
    "MATERIAL",
}  # fmt: skip
_TABLES = ("AMPLITUDE", "ORIENTATION", "DISTRIBUTION")
_OF_MATERIALS = ("HYPERELASTIC", "ANISOTROPIC HYPERELASTIC", "ELASTIC", "DENSITY")
_CONDITIONS = ("BOUNDARY", "CLOAD", "DLOAD", "DSLOAD")


def read_abaqus(file: DeckFile) -> Deck:
    """Return the content of an input file."""
    return _AbaqusReading(file, read_blocks(file)).deck()


class _AbaqusReading:
    """The tables of a deck that is being read.

    library : the blocks of each material, by its name in capitals.
    tables : amplitudes, orientations and distributions, by their keyword and name in capitals.
    finite : whether a step has NLGEOM.
    period : the time at the end of the last step.
    """

    def __init__(self, file: DeckFile, blocks: list[Block]) -> None:
        self.file, self.body = file, Instances(file)
        self.library: dict[str, list[Block]] = {}
        self.tables: dict[tuple[str, str], Block] = {}
        self.conditions: list[Block] = []
        self.prescribed: dict[tuple[str, int], float] = {}
        self.loads: list[Load] = []
        self.steps = [block for block in blocks if block.keyword == "STEP"]
        self.finite = any(s.options.get("NLGEOM", "NO").upper() != "NO" for s in self.steps)
        self.period, owner = 1.0, ""
        for block in blocks:
            name = block.options.get("NAME", "").upper()
            if block.keyword == "MATERIAL":
                self.library[owner := name] = []
            elif block.keyword in _OF_MATERIALS:
                self.library.setdefault(owner, []).append(block)
            elif block.keyword in _TABLES:
                self.tables[block.keyword, name] = block
            elif block.keyword in _CONDITIONS:
                self.conditions.append(block)
            elif block.keyword == "STATIC" and (times := block.first[1:2]) not in ([], [""]):
                self.period = file.numbers(times, block.line, 1)[0]
            elif not self.body.read(block) and block.keyword not in _SETTINGS:
                file.skip(block.line, block.described())

    def deck(self) -> Deck:
        """Return the content."""
        used = {s.options.get("MATERIAL", "").upper(): s.line for s in self.body.sections}
        library = {name: self._material(name, rows) for name, rows in self.library.items()
                   if name in used}  # fmt: skip
        material = only_material(self.file, library, used)
        for block in self.conditions:
            if block.options.get("OP", "").upper() == "NEW" and len(self.steps) > 1:
                self.file.skip(block.line, f"{block.described()}: earlier ones are kept")
            kind = block.options.get("TYPE", "DISPLACEMENT").upper()
            if kind != "DISPLACEMENT" or {"USER", "SUBMODEL", "LOAD CASE"} & set(block.options):
                self.file.skip(block.line, block.described())
                continue
            scale = self._amplitude(block)
            for line, row in block.numbered():
                self._read_condition(block, line, [*row, "", "", "", ""], scale, material)
        body = self.body
        axes = self._axes(material)
        whole = assemble(self.file, body.nodes, body.elements, body.node_sets, body.facet_sets)
        return finished("Abaqus", self.file, whole, material, self.prescribed, self.loads, axes)

    # Material.

    def _material(self, name: str, blocks: list[Block]) -> Material:
        density, laws = None, []
        for block in blocks:
            line = block.lines[0] if block.lines else block.line
            values = self.file.numbers(block.words(), line)
            if block.keyword == "DENSITY":
                density = values[0] if values else None
            elif block.keyword == "ELASTIC":
                isotropic = block.options.get("TYPE", "ISO")[:3].upper() == "ISO"
                if self.finite or not isotropic or len(block.rows) != 1 or len(values) < 2:
                    raise self.file.error(
                        block.line, "*Elastic is a law here without NLGEOM, of E and nu, only"
                    )
                E, nu = values[:2]  # a third number is a temperature
                laws.append(("small_strain_E_nu", {"E": E, "nu": nu}, block.line, ""))
            elif block.keyword == "HYPERELASTIC":
                laws.append((*self._isotropic(block, values), block.line, materials.QUADRATIC))
            elif "FUNG-ORTHOTROPIC" in block.options:
                laws.append((*self._fung(block, values), block.line, ""))
            else:
                laws.append((*self._families(block, values), block.line, ""))
        if len(laws) != 1:
            raise InputError(
                f"deck {self.file.path}: material '{name}' has {len(laws)} laws; expected one "
                "*Hyperelastic, *Anisotropic hyperelastic or *Elastic"
            )
        ((law, parameters, line, bulk),) = laws
        if not self.finite and self.steps and law != "small_strain_E_nu":
            self.file.note("the deck's step has no NLGEOM; the scene has finite strains")
        isochoric = law == "fung_orthotropic"
        return Material(law, parameters, line, density, bulk, isochoric)

    def _isotropic(self, block: Block, values: list[float]) -> Parameters:
        order = self.file.keys([block.options.get("N") or "1"], block.line)[0]
        options = " ".join(block.options)
        reduced, polynomial = "REDUCED" in options, "POLYNOMIAL" in options
        if "NEO HOOKE" in options or (reduced and order == 1):
            (c_10,), kappa = self._split(block, values, 1, 1)
            return "neo_hookean_split", {"mu": 2.0 * c_10, "kappa": kappa}
        if "MOONEY" in options or (polynomial and not reduced and order == 1):
            (c_10, c_01), kappa = self._split(block, values, 2, 1)
            return "mooney_rivlin", {"c_10": c_10, "c_01": c_01, "kappa": kappa}
        if "YEOH" in options or (reduced and order == 3):
            (c_1, c_2, c_3), kappa = self._split(block, values, 3, 3)
            return "yeoh", {"c_1": c_1, "c_2": c_2, "c_3": c_3, "kappa": kappa}
        if "OGDEN" in options:
            terms, kappa = self._split(block, values, 2 * order, order)
            return materials.ogden(terms[::2], terms[1::2], kappa)
        raise self.file.error(
            block.line, f"{block.described()} is no law of this package; it reads Neo Hooke, "
            "Mooney-Rivlin, Yeoh and Ogden",
        )  # fmt: skip

    def _split(
        self, block: Block, values: list[float], count: int, bulks: int
    ) -> tuple[list[float], float]:
        """Return the shape's constants and the bulk modulus 2 / D1."""
        bulk = values[count : count + bulks]
        if not bulk or bulk[0] <= 0.0:
            raise self.file.error(
                block.line, f"{len(values)} constants, D1 is 0: no law here is incompressible; "
                "give D1, 2 over some hundred times the shear modulus",
            )  # fmt: skip
        if len(values) > count + bulks + 1:  # one more is a temperature
            self.file.skip(block.line, f"{block.described()}: constants at further temperatures")
        if any(bulk[1:]):
            self.file.skip(block.line, f"{block.described()}: D2 and D3, which are not 0")
        return values[:count], 2.0 / bulk[0]

    def _families(self, block: Block, values: list[float]) -> Parameters:
        if "HOLZAPFEL" not in block.options or block.options.get("LOCAL DIRECTIONS") != "2":
            raise self.file.error(
                block.line, f"{block.described()}; expected Holzapfel with LOCAL DIRECTIONS=2"
            )
        if len(values) < 4 or values[1] <= 0.0:
            raise self.file.error(block.line, "expected C10, D above 0, k1, k2 and kappa")
        c_10, d, k_1, k_2, dispersion = [*values, 0.0][:5]
        one, other = self._directions(block.line)
        angle = 0.5 * float(np.degrees(np.arccos(one @ other)))
        return materials.fibre_families(2.0 * c_10, k_1, k_2, angle, dispersion, 2.0 / d)

    def _fung(self, block: Block, values: list[float]) -> Parameters:
        if len(values) < 11 or values[9] <= 0.0 or values[10] <= 0.0:
            raise self.file.error(block.line, "expected nine b_ijkl, c and D, both above 0")
        b_11, b_12, b_22, b_13, b_23, b_33, s_12, s_13, s_23, c, d = values[:11]
        normal = c * np.array([[b_11, b_12, b_13], [b_12, b_22, b_23], [b_13, b_23, b_33]])
        return materials.fung(c, normal, [c * s for s in (s_12, s_23, s_13)], 2.0 / d)

    # Directions.

    def _orientation(self) -> Block | None:
        """Return the orientation of the first solid section, the material's."""
        name = self.body.sections[0].options.get("ORIENTATION", "").upper()
        return self.tables.get(("ORIENTATION", name))

    def _directions(self, line: int) -> np.ndarray:
        """Return the directions (2, 3) of both families of fibres, in the local axes."""
        table = self._orientation()
        if table is None or table.options.get("LOCAL DIRECTIONS") != "2" or len(table.rows) < 3:
            raise self.file.error(line, "its section needs an *Orientation, LOCAL DIRECTIONS=2")
        rows = [*table.numbered()][-2:]
        return np.array([self.file.unit(np.array(self.file.numbers(row[:3], k, 3)), k)
                         for k, row in rows])  # fmt: skip

    def _axes(self, material: Material) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return the local axes of each element, or the bisectors of its two families of fibres."""
        table = self._orientation()
        if table is None or not find_law(material.law).fibres:
            return None, None
        bisectors = [np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])]
        if "LOCAL DIRECTIONS" in table.options:
            one, other = self._directions(table.line)
            bisectors = [self.file.unit(one + sign * other, table.line) for sign in (1.0, -1.0)]
        kinds = ("SYSTEM", "RECTANGULAR"), ("DEFINITION", "COORDINATES")
        if any(table.options.get(option, usual).upper() != usual for option, usual in kinds):
            raise self.file.error(
                table.line, f"{table.described()}; expected SYSTEM=RECTANGULAR by coordinates"
            )
        line, row = next(table.numbered())
        rows = {"": self._frame(row, line)} if len(row) > 3 else {}
        if not rows:
            data = self.tables.get(("DISTRIBUTION", row[0].upper()))
            if data is None:
                raise self.file.error(line, f"distribution '{row[0]}' is not in the deck")
            rows = {row[0]: self._frame(row[1:], line) for line, row in data.numbered()}
        frames = [rows.get(str(number), rows.get("")) for _, number in self.body.elements]
        if any(frame is None for frame in frames):
            raise self.file.error(table.line, "some elements have no orientation")
        turns = {owner: self.body.motion(owner)[0] for owner in self.body.instances}
        matrices = np.array([turns[owner] for owner, _ in self.body.elements]) @ np.array(frames)
        fibres, sheets = np.einsum("mij,dj->dmi", matrices, np.array(bisectors))
        return fibres, sheets

    def _frame(self, words: list[str], line: int) -> np.ndarray:
        """Return local axes, the columns of (3, 3), by a point on x and one in the plane x, y."""
        a, b = np.reshape(self.file.numbers([w for w in words if w][:6], line, 6), (2, 3))
        x, z = self.file.unit(a, line), self.file.unit(np.cross(a, b), line)
        return np.column_stack([x, np.cross(z, x), z])

    # Supports and loads.

    def _amplitude(self, block: Block) -> float:
        """Return the amplitude of a block at the end of the last step."""
        name = block.options.get("AMPLITUDE")
        if name is None:
            return 1.0
        table = self.tables.get(("AMPLITUDE", name.upper()))
        if table is None:
            raise self.file.error(block.line, f"amplitude '{name}' is not in the deck")
        numbers = self.file.numbers(table.words(), table.line)
        if not numbers or len(numbers) % 2:
            raise self.file.error(table.line, "an amplitude has pairs of time and value")
        return float(np.interp(self.period, numbers[::2], numbers[1::2]))

    def _read_condition(
        self, block: Block, line: int, row: list[str], scale: float, material: Material
    ) -> None:
        kind = row[1].upper()
        if block.keyword == "BOUNDARY":
            axes = self._axes_of(row, line)
            value = scale * self.file.numbers([row[3] or "0"], line, 1)[0]
            name = self.body.node_set(row[0], line)
            self.prescribed |= {(name, axis): value for axis in axes}
            read = bool(axes)
        elif block.keyword == "CLOAD":
            component = self.file.keys(row[1:2], line)[0]
            if read := component in (1, 2, 3) and "FOLLOWER" not in block.options:
                force = scale * self.file.numbers(row[2:3], line, 1)[0] * np.eye(3)[component - 1]
                name = self.body.node_set(row[0], line)
                self.loads += point_forces(self.file, line, self.body.node_sets, name, force)
        elif kind == "GRAV" and material.density is not None:
            size, *along = self.file.numbers(row[2:6], line, 4)
            if read := self._is_body(row[0], line):
                self.loads += weight(scale * material.density * size * np.array(along))
        else:
            read = self._read_on_surface(block, line, row, scale)
        if not read:
            self.file.skip(line, ", ".join(word for word in row if word))

    def _axes_of(self, row: list[str], line: int) -> list[int]:
        """Return the components 0 to 2 that a row of *Boundary prescribes."""
        if row[1].upper() in _FIXED:
            return [*_FIXED[row[1].upper()]]
        first, last = self.file.keys([row[1], row[2] or row[1]], line)
        return [k - 1 for k in range(first, last + 1) if 1 <= k <= 3]

    def _read_on_surface(self, block: Block, line: int, row: list[str], scale: float) -> bool:
        kind, face = row[1].upper(), f"S{row[1][1:]}"
        keeps = block.options.get("FOLLOWER", "YES").upper() == "NO"  # its direction
        keeps = keeps and block.options.get("CONSTANT RESULTANT", "NO").upper() == "YES"
        if kind == "TRVEC" and (keeps or not self.finite):
            size, *direction = self.file.numbers(row[2:6], line, 4)
            x, y, z = scale * size * self.file.unit(np.array(direction), line)
            name = self.body.surface(row[0], line)
            self.loads.append(Traction(name, (float(x), float(y), float(z))))
            return True
        pressure = FollowerPressure if self.finite else DeadPressure
        value = scale * self.file.numbers(row[2:3] if kind[:1] == "P" else ["0"], line, 1)[0]
        if block.keyword == "DSLOAD" and kind == "P":
            self.loads.append(pressure(self.body.surface(row[0], line), value))
        elif block.keyword == "DLOAD" and kind[:1] == "P" and face[1:].isdecimal():
            # Decks list faces one by one: those of one pressure are one surface.
            name = f"{row[2]} of line {block.line}"
            facets = self.body.facets("", [(line, [row[0], face])])
            if facets and name not in self.body.facet_sets:
                self.loads.append(pressure(name, value))
            self.body.facet_sets.setdefault(name, []).extend(facets)
        else:
            return False
        return True

    def _is_body(self, word: str, line: int) -> bool:
        """Say whether a word names all elements, as no word does."""
        return not word or {*self.body.elements_of("", word, line)} == {*self.body.elements}
