"""Decks of FEBio, formats 2.5, 3.0 and 4.0.

The state at the end of the first step is read: values times their load curves at its end time.
FEBio's body forces act against their sign (``FEElasticSolidDomain::BodyForce`` subtracts them), a
positive pressure pushes into the tissue.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emulator.neighbours.decks import materials
from emulator.neighbours.decks.deck import (
    AXES,
    Deck,
    DeckFile,
    Element,
    assemble,
    only_material,
    point_forces,
    support,
    weight,
)
from emulator.neighbours.decks.materials import Material
from emulator.neighbours.decks.tags import Tag, read_tags
from emulator.scenes.loads import DeadPressure, FollowerPressure, Traction
from emulator.scenes.part import Load

_VERSIONS = ("2.5", "3.0", "4.0")
_WIDTHS = {"tet4": 4, "tet10": 10}
_TRIANGLES = ("tri3", "tri6")
_SETTINGS = {"Module", "Control", "Globals", "Output", "LoadData"}
_BULK = {
    "default": "kappa/2 (ln J)^2", "0": "kappa/2 (ln J)^2", "NIKE3D": "", "1": "",
    "Abaqus": "kappa/2 (J - 1)^2", "2": "kappa/2 (J - 1)^2", "Abaqus (GOH)": "", "3": "",
}  # fmt: skip


def read_febio(file: DeckFile) -> Deck:
    """Return the content of a deck of FEBio."""
    root = read_tags(file)
    if root.name != "febio_spec":
        raise file.error(root.line, f"<{root.name}>; expected <febio_spec>")
    version = root.attributes.get("version", "")
    if version not in _VERSIONS:
        known = ", ".join(_VERSIONS)
        raise file.error(root.line, f"febio_spec version '{version}'; {known} are read")
    module = root.first("Module")
    if module is not None and (kind := module.attributes.get("type", "solid")) != "solid":
        raise file.error(module.line, f"module '{kind}'; only solid is read")
    return _Reading(file, root).deck()


class _Reading:
    """The tables of a deck that is being read.

    nodes : coordinates by number.
    elements : tetrahedra by number.
    blocks : the numbers of the elements of each block, by its name.
    """

    def __init__(self, file: DeckFile, root: Tag) -> None:
        self.file, self.root = file, root
        self.nodes: dict[int, list[float]] = {}
        self.elements: dict[int, Element] = {}
        self.blocks: dict[str, list[int]] = {}
        self.used: dict[str, int] = {}
        self.node_sets: dict[str, list[int]] = {}
        self.facet_sets: dict[str, list[tuple[int, ...]]] = {}
        self.prescribed: dict[str, dict[int, float]] = {}
        self.loads: list[Load] = []

    def deck(self) -> Deck:
        """Return the content."""
        steps = [step for tag in self.root.all("Step") for step in (*tag.all("step"), tag)]
        steps = [step for step in steps if step.first("step") is None]
        for step in steps[1:]:
            self.file.skip(step.line, f"{step.described()}, a further step")
        for tag in self.root.children:
            if tag.name in ("Geometry", "Mesh"):
                self._read_mesh(tag)
        for tag in self.root.all("MeshDomains"):
            for domain in tag.children:
                self.used[domain.attributes.get("mat", "")] = domain.line
        library, names = self._materials()
        used = {names.get(name, name): line for name, line in self.used.items()}
        material = only_material(self.file, library, used)
        sections = [*self.root.children, *(steps[0].children if steps else ())]
        self.end = self._end_time([*sections[::-1]])
        for tag in sections:
            if tag.name == "Boundary":
                self._read_boundary(tag)
            elif tag.name == "Loads":
                self._read_loads(tag, material.density)
            elif tag.name == "MeshData":
                continue
            elif tag.name not in _SETTINGS | {
                "Geometry", "Mesh", "MeshDomains", "Material", "Step", "step",
            }:  # fmt: skip
                for child in tag.children or [tag]:
                    self.file.skip(child.line, f"{child.described()} in {tag.name}")
        mesh = assemble(self.file, self.nodes, self.elements, self.node_sets, self.facet_sets)
        fibres, sheets = self._axes()
        supports = tuple(support(name, values) for name, values in self.prescribed.items())
        for sentence in material.notes():
            self.file.note(sentence)
        return Deck(
            "FEBio", mesh, material, supports, tuple(self.loads), fibres, sheets,
            tuple(self.file.unread), tuple(self.file.notes),
        )  # fmt: skip

    # Mesh.

    def _read_mesh(self, mesh: Tag) -> None:
        readers = {
            "Nodes": self._read_nodes,
            "Elements": self._read_elements,
            "NodeSet": self._read_node_set,
            "Surface": self._read_surface,
        }
        for tag in mesh.children:
            if tag.name in readers:
                readers[tag.name](tag)
            elif tag.name != "ElementSet":
                self.file.skip(tag.line, f"{tag.described()} in {mesh.name}")

    def _read_nodes(self, tag: Tag) -> None:
        for node in tag.all("node", "n"):
            number = self._number(node)
            if number in self.nodes:
                raise self.file.error(node.line, f"node {number} is there before")
            self.nodes[number] = self.file.numbers(node.text, node.line, 3)
        if "name" in tag.attributes:
            self.node_sets[tag.attributes["name"]] = [self._number(n) for n in tag.children]

    def _read_elements(self, tag: Tag) -> None:
        kind = tag.attributes.get("type", "")
        if kind not in _WIDTHS:
            raise self.file.error(
                tag.line, f"elements '{kind}'; expected tetrahedra only (tet4 or tet10): mesh or "
                "split the volume into them",
            )  # fmt: skip
        block = self.blocks.setdefault(tag.attributes.get("name", ""), [])
        for element in tag.all("elem", "e"):
            number = self._number(element)
            if number in self.elements:
                raise self.file.error(element.line, f"element {number} is there before")
            words = element.text.replace(",", " ").split()
            nodes = tuple(self.file.keys(words, element.line))
            if len(nodes) != _WIDTHS[kind]:
                raise self.file.error(
                    element.line, f"{len(nodes)} nodes; expected {_WIDTHS[kind]}, as of a {kind}"
                )
            self.elements[number] = Element(nodes, element.line)
            block.append(number)
        if "mat" in tag.attributes:
            self.used[tag.attributes["mat"]] = tag.line

    def _read_node_set(self, tag: Tag) -> None:
        numbers = [self._number(node) for node in tag.all("node", "n")]
        for word in tag.text.replace(",", " ").split():
            first, *rest = self.file.keys(word.split(":"), tag.line)
            last, step = (rest[0] if rest else first), (rest[1] if len(rest) > 1 else 1)
            numbers += range(first, last + 1, max(step, 1))
        for number in numbers:
            if number not in self.nodes:
                raise self.file.error(tag.line, f"node set has node {number}, which does not exist")
        self.node_sets[tag.attributes.get("name", "")] = numbers

    def _read_surface(self, tag: Tag) -> None:
        rows = []
        for facet in tag.children:
            if facet.name not in _TRIANGLES:
                raise self.file.error(facet.line, f"facet '{facet.name}'; expected triangles")
            words = facet.text.replace(",", " ").split()
            rows.append(tuple(self.file.keys(words, facet.line)))
        self.facet_sets[tag.attributes.get("name", "")] = rows

    def _number(self, tag: Tag) -> int:
        return self.file.keys([tag.attributes.get("id", "")], tag.line)[0]

    # Directions.

    def _axes(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return the directions of the elements, those of each over those of the material."""
        rows = {number: k for k, number in enumerate(self.elements)}
        axes = np.full((2, len(rows), 3), np.nan)
        for material in (m for tag in self.root.all("Material") for m in tag.all("material")):
            for tag in material.all("mat_axis", "fiber"):
                if not self._set_axes(tag, axes, slice(None)):
                    self.file.skip(tag.line, tag.described())
        for data in (d for tag in self.root.all("MeshData") for d in tag.children):
            which = data.attributes.get("var", data.attributes.get("type", ""))
            block = self.blocks.get(data.attributes.get("elem_set", ""))
            if which not in ("mat_axis", "fiber") or block is None:
                self.file.skip(data.line, f"{data.described()} in MeshData")
                continue
            for tag in data.all("elem", "e"):
                local = self.file.keys([tag.attributes.get("lid", "")], tag.line)[0]
                if not 1 <= local <= len(block):
                    raise self.file.error(tag.line, f"lid {local} of {len(block)} elements")
                self._set_axes(tag, axes, rows[block[local - 1]])
        fibres, sheets = axes
        return (
            None if np.isnan(fibres).any() else fibres,
            None if np.isnan(sheets).any() else sheets,
        )

    def _set_axes(self, tag: Tag, axes: np.ndarray, rows: int | slice) -> bool:
        """Set fibre and sheet directions of elements from vectors; say whether they were there.

        FEBio's axes are a, then d without its part along a (``mat_axis``).
        """
        if tag.attributes.get("type", "vector") != "vector":
            return False
        first = tag.first("a")
        a = np.array(self.file.numbers(tag.text if first is None else first.text, tag.line, 3))
        axes[0, rows] = _unit(self.file, tag, a)
        if first is not None:
            d = np.array(self.file.numbers(tag.words("d"), tag.line, 3))
            axes[1, rows] = _unit(self.file, tag, d - (d @ a) / (a @ a) * a)
        return True

    # Materials.

    def _materials(self) -> tuple[dict[str, Material], dict[str, str]]:
        """Return the materials that elements have by number, and their numbers by any name."""
        tags = [m for tag in self.root.all("Material") for m in tag.all("material")]
        names = {m.attributes.get(key, ""): m.attributes.get("id", "") for m in tags
                 for key in ("id", "name")}  # fmt: skip
        wanted = {names.get(name, name) for name in self.used}
        used = [m for m in tags if m.attributes.get("id", "") in wanted]
        return {m.attributes.get("id", ""): self._material(m) for m in used}, names

    def _material(self, tag: Tag) -> Material:
        kind = tag.attributes.get("type", "")
        known = {
            "neo-Hookean": self._neo_hookean, "incomp neo-Hookean": self._split,
            "Mooney-Rivlin": self._mooney_rivlin, "Ogden": self._ogden,
            "Holzapfel-Gasser-Ogden": self._families,
        }  # fmt: skip
        if kind not in known:
            names = ", ".join(known)
            raise self.file.error(
                tag.line, f"material '{kind}' is no law of this package; it reads {names}"
            )
        law, values = known[kind](tag)
        parameters = {"density", "mat_axis", "fiber", "pressure_model", "E", "v", "G", "k", "c",
                      "k1", "k2", "gamma", "kappa"}  # fmt: skip
        numbered = {f"{letter}{k}" for letter in "cm" for k in range(1, 7)}
        for child in tag.children:
            if child.name not in parameters | numbered:
                self.file.skip(child.line, f"{child.described()} of the material")
        usual = "3" if kind.startswith("Holzapfel") else "0"
        bulk = "" if "kappa" not in values else _BULK.get(
            tag.words("pressure_model", usual), f"pressure_model {tag.words('pressure_model')}"
        )  # fmt: skip
        density = self._value(tag, "density", 1.0)
        return Material(law, values, tag.line, density, bulk)

    def _neo_hookean(self, tag: Tag) -> tuple[str, dict[str, float]]:
        return "neo_hookean_E_nu", {"E": self._value(tag, "E"), "nu": self._value(tag, "v")}

    def _split(self, tag: Tag) -> tuple[str, dict[str, float]]:
        return "neo_hookean_split", {"mu": self._value(tag, "G"), "kappa": self._value(tag, "k")}

    def _mooney_rivlin(self, tag: Tag) -> tuple[str, dict[str, float]]:
        names = {"c_10": "c1", "c_01": "c2", "kappa": "k"}
        return "mooney_rivlin", {ours: self._value(tag, name) for ours, name in names.items()}

    def _ogden(self, tag: Tag) -> tuple[str, dict[str, float]]:
        c, m = ([self._value(tag, f"{letter}{k}", 0.0) for k in range(1, 7)] for letter in "cm")
        law = materials.ogden([0.5 * x for x in c], m, self._value(tag, "k"))
        if law is None:
            raise self.file.error(tag.line, "Ogden of more than three terms, or of none")
        return law

    def _families(self, tag: Tag) -> tuple[str, dict[str, float]]:
        values = [self._value(tag, name) for name in ("c", "k1", "k2", "gamma", "kappa", "k")]
        return materials.fibre_families(*values)

    def _value(self, tag: Tag, name: str, default: float | None = None) -> float:
        """Return a number of a material or a load, times its load curve at the end."""
        child = tag.first(name)
        if child is None:
            if default is None:
                raise self.file.error(tag.line, f"{tag.described()} has no <{name}>")
            return default
        if child.attributes.get("type", "const") != "const":
            raise self.file.error(child.line, f"{child.described()}; expected a number")
        return self.file.numbers(child.text, child.line, 1)[0]

    # Supports and loads.

    def _read_boundary(self, boundary: Tag) -> None:
        for tag in boundary.children:
            kind = tag.attributes.get("type", tag.name)
            if kind in ("fix", "zero displacement"):
                values = dict.fromkeys(self._components(tag), 0.0)
            elif kind in ("prescribe", "prescribed displacement"):
                amount = self._scaled(tag, "value", 1.0) * self._scaled(tag, "scale", 1.0)
                if tag.words("relative", "0") not in ("0", ""):
                    self.file.skip(tag.line, f"{tag.described()} relative to an earlier step")
                    continue
                values = dict.fromkeys(self._components(tag), amount)
            else:
                self.file.skip(tag.line, f"{tag.described()} in Boundary")
                continue
            if not values:
                self.file.skip(tag.line, f"{tag.described()}, of no displacement")
                continue
            self.prescribed.setdefault(self._node_set(tag), {}).update(values)

    def _components(self, tag: Tag) -> list[int]:
        """Return the components 0 to 2 that a condition names, in any of the formats."""
        words = ",".join([tag.attributes.get("bc", ""), tag.words("dofs"), tag.words("dof")])
        flags = [a for a in AXES if tag.words(f"{a}_dof", "0") not in ("0", "")]
        names = [word.strip() for word in words.split(",")]
        letters = {letter for name in names if not set(name) - set(AXES) for letter in name}
        return [AXES.index(letter) for letter in sorted({*letters, *flags})]

    def _node_set(self, tag: Tag) -> str:
        name = tag.attributes.get("node_set", "")
        if name.startswith("@surface:"):
            name = name.removeprefix("@surface:")
            self.file.known(name, self.facet_sets, "surface", tag.line)
            nodes = dict.fromkeys(k for row in self.facet_sets[name] for k in row)
            self.node_sets.setdefault(name, [*nodes])
        return self.file.known(name, self.node_sets, "node set", tag.line)

    def _read_loads(self, loads: Tag, density: float | None) -> None:
        readers = {
            "surface_load": self._read_surface_load,
            "nodal_load": self._read_nodal_load,
            "body_load": lambda tag: self._read_body_load(tag, density or 1.0),
        }
        for tag in loads.children:
            if tag.name not in readers or not readers[tag.name](tag):
                self.file.skip(tag.line, f"{tag.described()} in Loads")

    def _read_surface_load(self, tag: Tag) -> bool:
        kind = tag.attributes.get("type", "")
        if kind not in ("pressure", "traction"):
            return False
        name = tag.attributes.get("surface", "")
        self.file.known(name, self.facet_sets, "surface", tag.line)
        scale = self._scaled(tag, "scale", 1.0)
        if kind == "pressure":
            pressure = self._scaled(tag, "pressure") * scale
            dead = tag.words("linear", "0") == "1"
            self.loads.append((DeadPressure if dead else FollowerPressure)(name, pressure))
        else:
            vector = [scale * x for x in self._vector(tag, "traction")]
            self.loads.append(Traction(name, (vector[0], vector[1], vector[2])))
        return True

    def _read_nodal_load(self, tag: Tag) -> bool:
        force = np.zeros(3)
        if tag.attributes.get("type") == "nodal_force":
            force += self._vector(tag, "value")
        else:
            components = self._components(tag)
            if not components:
                return False
            force[components] = self._scaled(tag, "scale", 1.0) * self._scaled(tag, "value", 1.0)
        name = self._node_set(tag)
        nodes = self.node_sets[name]
        for point, (key, load) in zip(
            nodes, point_forces(self.file, tag.line, name, len(nodes), force), strict=False
        ):
            self.node_sets[key] = [point]
            self.loads.append(load)
        return True

    def _read_body_load(self, tag: Tag, density: float) -> bool:
        kind = tag.attributes.get("type", "")
        if kind == "const":
            vector = [self._scaled(tag, axis, 0.0) for axis in AXES]
        elif kind == "body force":
            vector = self._vector(tag, "force")
        else:
            return False
        load = weight([-density * x for x in vector])
        self.loads += [load] if load is not None else []
        return True

    def _vector(self, tag: Tag, name: str) -> list[float]:
        child = tag.first(name)
        if child is None or child.attributes.get("type", "const") not in ("const", "vector"):
            raise self.file.error(tag.line, f"{tag.described()}: expected <{name}> of 3 numbers")
        return [self._curve(child) * x for x in self.file.numbers(child.text, child.line, 3)]

    def _scaled(self, tag: Tag, name: str, default: float | None = None) -> float:
        child = tag.first(name)
        value = self._value(tag, name, default)
        return value if child is None else value * self._curve(child)

    # Load curves.

    def _end_time(self, sections: list[Tag]) -> float | None:
        control = next((tag for tag in sections if tag.name == "Control"), None)
        if control is None or control.first("time_steps") is None:
            return None
        return self._value(control, "time_steps") * self._value(control, "step_size", 1.0)

    def _curve(self, tag: Tag) -> float:
        """Return the load curve of a value at the end of the step; 1 without one."""
        number = tag.attributes.get("lc")
        if number is None:
            return 1.0
        curves = [c for data in self.root.all("LoadData") for c in data.children]
        curve = next((c for c in curves if c.attributes.get("id") == number), None)
        points = list(_points(curve)) if curve is not None else []
        if curve is None or not points:
            raise self.file.error(tag.line, f"load curve {number} is not there, or has no points")
        times, values = np.array([self.file.numbers(p.text, p.line, 2) for p in points]).T
        end = times[-1] if self.end is None else self.end
        inside = end < times[-1] * (1.0 - 1e-12)
        kind = curve.attributes.get("type", "") if curve.name == "loadcurve" else ""
        smooth = (curve.words("interpolate") or kind or "linear").lower() != "linear"
        beyond = end > times[-1] * (1.0 + 1e-12)
        extended = (curve.words("extend") or curve.attributes.get("extend", "constant")).lower()
        if (inside and smooth) or (beyond and extended != "constant"):
            self.file.skip(curve.line, f"load curve {number} at time {end:g}; its last value")
            return float(values[-1])
        return float(np.interp(end, times, values))


def _points(curve: Tag) -> Iterator[Tag]:
    """Yield the points of a curve, in any of the formats."""
    for tag in (curve, *curve.all("points")):
        yield from tag.all("point", "pt", "loadpoint")


def _unit(file: DeckFile, tag: Tag, vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    if not length > 0.0:
        raise file.error(tag.line, "a direction of length zero")
    return vector / length
