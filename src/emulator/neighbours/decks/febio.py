"""Decks of FEBio, formats 2.5, 3.0 and 4.0.

The state at the end of the first step is read: values times their load curves at its end time.
FEBio's body forces act against their sign (``FEElasticSolidDomain::BodyForce`` subtracts them), a
positive pressure pushes into the tissue.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from emulator.mechanics.kinematics import cofactor, determinant
from emulator.neighbours.decks import materials
from emulator.neighbours.decks.deck import (
    AXES,
    Deck,
    DeckFile,
    Element,
    assemble,
    finished,
    only_material,
    point_forces,
    weight,
)
from emulator.neighbours.decks.materials import Material, Parameters
from emulator.neighbours.decks.tags import Tag, number, read_tags
from emulator.scenes.loads import DeadPressure, FollowerPressure, Traction
from emulator.scenes.part import Load

_VERSIONS = ("2.5", "3.0", "4.0")
_WIDTHS = {"tet4": 4, "tet10": 10, "penta6": 6, "hex8": 8}
_SETTINGS = {
    "Module", "Control", "Globals", "Output", "LoadData", "Geometry", "Mesh", "MeshDomains",
    "MeshData", "Material", "Step", "step",
}  # fmt: skip
_LAWS = {
    "neo-Hookean": ("neo_hookean_E_nu", {"E": "E", "nu": "v"}),
    "incomp neo-Hookean": ("neo_hookean_split", {"mu": "G", "kappa": "k"}),
    "Mooney-Rivlin": ("mooney_rivlin", {"c_10": "c1", "c_01": "c2", "kappa": "k"}),
}
_OGDEN, _FAMILIES = "Ogden", "Holzapfel-Gasser-Ogden"
_FUNG = {"Fung-ortho-compressible": False, "Fung orthotropic": True}
"""Whether Fung's exponential is of the isochoric strain."""
_PARAMETERS = {
    "density", "mat_axis", "fiber", "pressure_model", "E", "v", "G", "k", "c", "k1", "k2", "gamma",
    "kappa", *(f"{letter}{k}" for letter in "cm" for k in range(1, 7)),
    "E1", "E2", "E3", "G12", "G23", "G31", "v12", "v23", "v31",
}  # fmt: skip
_BULKS = {
    "default": materials.LOGARITHMIC, "0": materials.LOGARITHMIC, "NIKE3D": "", "1": "",
    "Abaqus": materials.QUADRATIC, "2": materials.QUADRATIC, "Abaqus (GOH)": "", "3": "",
}  # fmt: skip


def read_febio(file: DeckFile) -> Deck:
    """Return the content of a deck of FEBio."""
    root = read_tags(file)
    version = root.attributes.get("version", "")
    if root.name != "febio_spec" or version not in _VERSIONS:
        known = ", ".join(_VERSIONS)
        raise file.error(root.line, f"{root.described()}; expected <febio_spec>, version {known}")
    module = root.first("Module")
    if module is not None and (kind := module.attributes.get("type", "solid")) != "solid":
        raise file.error(module.line, f"module '{kind}'; only solid is read")
    return _FebioReading(file, root).deck()


class _FebioReading:
    """The tables of a deck that is being read.

    nodes : coordinates by number.
    elements : elements by number.
    blocks : the numbers of the elements of each block, by its name.
    used : the line that names each material, by number or name.
    end : the time at which load curves are read; None for that of their last points.
    """

    def __init__(self, file: DeckFile, root: Tag) -> None:
        self.file, self.root = file, root
        self.nodes: dict[int, list[float]] = {}
        self.elements: dict[int, Element] = {}
        self.blocks: dict[str, list[int]] = {}
        self.used: dict[str, int] = {}
        self.node_sets: dict[str, list[int]] = {}
        self.facet_sets: dict[str, list[tuple[int, ...]]] = {}
        self.prescribed: dict[tuple[str, int], float] = {}
        self.loads: list[Load] = []
        self.end: float | None = None
        # FEBio 4 takes tractions per area as it is, earlier versions per area at rest.
        self.usual_linear = "0" if root.attributes["version"] == "4.0" else "1"

    def deck(self) -> Deck:
        """Return the content."""
        steps = [step for tag in self.root.all("Step") for step in [*tag.all("step")] or [tag]]
        for step in steps[1:]:
            self.file.skip(step.line, f"{step.described()}, a further step")
        for tag in self.root.all("Geometry", "Mesh"):
            self._read_mesh(tag)
        for tag in self.root.all("MeshDomains"):
            self.used |= {domain.attributes.get("mat", ""): domain.line for domain in tag.children}
        material = self._only_material()
        sections = [*self.root.children, *(step for tag in steps[:1] for step in tag.children)]
        for control in (tag for tag in sections if tag.name == "Control"):
            if control.first("time_steps") is not None:
                count = number(self.file, control, "time_steps")
                self.end = count * number(self.file, control, "step_size", 1.0)
        for tag in sections:
            for child in tag.children:
                if tag.name == "Boundary":
                    done = self._read_condition(child)
                elif tag.name == "Loads":
                    done = self._read_load(child, material.density or 1.0)
                else:
                    done = tag.name in _SETTINGS
                if not done:
                    self.file.skip(child.line, f"{child.described()} in {tag.name}")
        axes = self._axes()
        body = assemble(self.file, self.nodes, self.elements, self.node_sets, self.facet_sets)
        return finished("FEBio", self.file, body, material, self.prescribed, self.loads, axes)

    # Mesh.

    def _read_mesh(self, mesh: Tag) -> None:
        for tag in mesh.children:
            name = tag.attributes.get("name", "")
            if tag.name == "Nodes":
                for node in tag.children:
                    if (key := self._key(node)) in self.nodes:
                        raise self.file.error(node.line, f"node {key} is there before")
                    self.nodes[key] = self.file.numbers(node.text, node.line, 3)
            elif tag.name == "Elements":
                self._read_elements(tag)
            elif tag.name == "NodeSet":
                self.node_sets[name] = self._read_node_set(tag)
            elif tag.name == "Surface":
                for facet in tag.children:
                    if facet.name not in ("tri3", "tri6", "quad4"):
                        what = f"{facet.name}; expected triangles or quad4"
                        raise self.file.error(facet.line, what)
                self.facet_sets[name] = [self._keys(facet) for facet in tag.children]
            elif tag.name != "ElementSet":
                self.file.skip(tag.line, f"{tag.described()} in {mesh.name}")

    def _read_elements(self, tag: Tag) -> None:
        width = _WIDTHS.get(kind := tag.attributes.get("type", ""))
        if width is None:
            raise self.file.error(
                tag.line, f"elements '{kind}'; expected tetrahedra (tet4 or tet10), penta6 or "
                "hex8: mesh the volume with them",
            )  # fmt: skip
        block = self.blocks.setdefault(tag.attributes.get("name", ""), [])
        for element in tag.children:
            if (key := self._key(element)) in self.elements:
                raise self.file.error(element.line, f"element {key} is there before")
            nodes = self._keys(element)
            if len(nodes) != width:
                raise self.file.error(element.line, f"{len(nodes)} nodes; a {kind} has {width}")
            self.elements[key] = Element(nodes, element.line)
            block.append(key)
        if "mat" in tag.attributes:
            self.used[tag.attributes["mat"]] = tag.line

    def _read_node_set(self, tag: Tag) -> list[int]:
        keys = [self._key(node) for node in tag.children]
        for word in tag.text.replace(",", " ").split():
            words = word.split(":")  # a number, or first:last:step
            keys += self.file.span(words if len(words) > 1 else [word, word], tag.line)
        for key in keys:
            if key not in self.nodes:
                raise self.file.error(tag.line, f"a set has node {key}, which does not exist")
        return keys

    def _key(self, tag: Tag, name: str = "id") -> int:
        return self.file.keys([tag.attributes.get(name, "")], tag.line)[0]

    def _keys(self, tag: Tag) -> tuple[int, ...]:
        return tuple(self.file.keys(tag.text.replace(",", " ").split(), tag.line))

    # Directions.

    def _axes(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return the directions of the elements, those of an element over those of a material."""
        rows = {key: k for k, key in enumerate(self.elements)}
        axes = np.full((2, len(rows), 3), np.nan)
        for material in (m for tag in self.root.all("Material") for m in tag.children):
            for tag in material.all("mat_axis", "fiber"):
                if tag.attributes.get("type", "vector") == "vector":
                    self._set_axes(tag, axes, slice(None))
                else:
                    self.file.skip(tag.line, tag.described())
        for data in (d for tag in self.root.all("MeshData") for d in tag.children):
            which = data.attributes.get("var", data.attributes.get("type", ""))
            block = self.blocks.get(data.attributes.get("elem_set", ""))
            if which not in ("mat_axis", "fiber") or block is None:
                self.file.skip(data.line, f"{data.described()} in MeshData")
                continue
            for tag in data.children:
                if not 1 <= (local := self._key(tag, "lid")) <= len(block):
                    raise self.file.error(tag.line, f"lid {local} of {len(block)} elements")
                self._set_axes(tag, axes, rows[block[local - 1]])
        fibres, sheets = (None if np.isnan(rows).any() else rows for rows in axes)
        return fibres, sheets

    def _set_axes(self, tag: Tag, axes: np.ndarray, rows: int | slice) -> None:
        """Set the directions of elements: a, and d without its part along a."""
        first, second = tag.first("a") or tag, tag.first("d")
        a = np.array(self.file.numbers(first.text, tag.line, 3))
        axes[0, rows] = self.file.unit(a, tag.line)
        if second is not None:
            d = np.array(self.file.numbers(second.text, tag.line, 3))
            axes[1, rows] = self.file.unit(d - (d @ a) / (a @ a) * a, tag.line)

    # Materials.

    def _only_material(self) -> Material:
        tags = [m for tag in self.root.all("Material") for m in tag.all("material")]
        ids = {m.attributes.get(k, ""): m.attributes.get("id", "") for m in tags
               for k in ("name", "id")}  # fmt: skip
        used = {ids.get(name, name): line for name, line in self.used.items()}
        wanted = (m for m in tags if m.attributes.get("id", "") in used)
        library = {m.attributes.get("id", ""): self._material(m) for m in wanted}
        return only_material(self.file, library, used)

    def _material(self, tag: Tag) -> Material:
        kind = tag.attributes.get("type", "")
        if kind in _LAWS:
            law, names = _LAWS[kind]
            values = {ours: number(self.file, tag, name) for ours, name in names.items()}
        elif kind == _OGDEN:
            c, m = ([number(self.file, tag, f"{x}{k}", 0.0) for k in range(1, 7)] for x in "cm")
            halves = [0.5 * x for x in c]
            law, values = materials.ogden(halves, m, number(self.file, tag, "k"))
        elif kind == _FAMILIES:
            numbers = [number(self.file, tag, n) for n in ("c", "k1", "k2", "gamma", "kappa", "k")]
            law, values = materials.fibre_families(*numbers)
        elif kind in _FUNG:
            law, values = self._fung(tag)
        else:
            known = ", ".join([*_LAWS, _OGDEN, _FAMILIES, *_FUNG])
            raise self.file.error(
                tag.line, f"material '{kind}' is no law of this package; it reads {known}"
            )
        for child in tag.children:
            if child.name not in _PARAMETERS:
                self.file.skip(child.line, f"{child.described()} of the material")
        model = tag.words("pressure_model", "3" if kind == _FAMILIES else "0")
        bulk = _BULKS.get(model, f"pressure_model {model}") if "kappa" in values else ""
        density = number(self.file, tag, "density", 1.0)
        return Material(law, values, tag.line, density, bulk, _FUNG.get(kind, False))

    def _fung(self, tag: Tag) -> Parameters:
        E = [number(self.file, tag, name) for name in ("E1", "E2", "E3")]
        c, kappa = (number(self.file, tag, name) for name in ("c", "k"))
        if not min(*E, c) > 0.0:
            raise self.file.error(tag.line, "E1, E2, E3 and c of the material; expected above 0")
        compliance = np.diag(1.0 / np.array(E))
        for row, name in enumerate(("v12", "v23", "v31")):
            column = (row + 1) % 3
            ratio = -number(self.file, tag, name) / E[row]
            compliance[row, column] = compliance[column, row] = ratio
        if np.linalg.eigvalsh(compliance)[0] <= 0.0:
            raise self.file.error(tag.line, "E and v of the material are no positive stiffness")
        shear = [number(self.file, tag, name) for name in ("G12", "G23", "G31")]
        S = jnp.asarray(compliance)
        stiffness = np.asarray(cofactor(S) / determinant(S))  # S is symmetric
        return materials.fung(c, stiffness, shear, kappa)

    # Supports and loads.

    def _read_condition(self, tag: Tag) -> bool:
        kind, value = tag.attributes.get("type", tag.name), 0.0
        if kind in ("prescribe", "prescribed displacement"):
            value = self._scaled(tag, "value", 1.0) * self._scaled(tag, "scale", 1.0)
        elif kind not in ("fix", "zero displacement"):
            return False
        axes = self._components(tag)
        if not axes or tag.words("relative", "0") not in ("0", ""):
            return False
        name = self._node_set(tag)
        self.prescribed |= {(name, axis): value for axis in axes}
        return True

    def _components(self, tag: Tag) -> list[int]:
        """Return the components 0 to 2 that a condition names, in any of the formats."""
        words = ",".join([tag.attributes.get("bc", ""), tag.words("dofs"), tag.words("dof")])
        names = [word.strip() for word in words.split(",")]
        names += [axis for axis in AXES if tag.words(f"{axis}_dof", "0") not in ("0", "")]
        letters = {letter for name in names if not set(name) - set(AXES) for letter in name}
        return [AXES.index(letter) for letter in sorted(letters)]

    def _node_set(self, tag: Tag) -> str:
        name = tag.attributes.get("node_set", "")
        if name.startswith("@surface:"):
            name = self._surface(tag, name.removeprefix("@surface:"))
            nodes = dict.fromkeys(k for row in self.facet_sets[name] for k in row)
            self.node_sets.setdefault(name, [*nodes])
        return self.file.known(name, self.node_sets, "node set", tag.line)

    def _surface(self, tag: Tag, name: str) -> str:
        return self.file.known(name, self.facet_sets, "surface", tag.line)

    def _read_load(self, tag: Tag, density: float) -> bool:
        kind = f"{tag.name} {tag.attributes.get('type', '')}"
        if kind == "surface_load pressure":
            name = self._surface(tag, tag.attributes.get("surface", ""))
            load = DeadPressure if tag.words("linear", "0") == "1" else FollowerPressure
            self.loads.append(load(name, self._scaled(tag, "pressure")))
        elif kind == "surface_load traction":
            if tag.words("linear", self.usual_linear) != "1":
                return False  # per area as it is
            name = self._surface(tag, tag.attributes.get("surface", ""))
            x, y, z = self._vector(tag, "traction") * self._scaled(tag, "scale", 1.0)
            self.loads.append(Traction(name, (float(x), float(y), float(z))))
        elif tag.name == "nodal_load":
            if kind == "nodal_load nodal_force":
                force = self._vector(tag, "value")
            else:
                value = self._scaled(tag, "scale", 1.0) * self._scaled(tag, "value", 1.0)
                force = value * np.eye(3)[self._components(tag)].sum(axis=0)
            if not force.any():
                return False
            name = self._node_set(tag)
            self.loads += point_forces(self.file, tag.line, self.node_sets, name, force)
        elif kind == "body_load const":
            self.loads += weight([-density * self._scaled(tag, axis, 0.0) for axis in AXES])
        elif kind == "body_load body force":
            self.loads += weight(-density * self._vector(tag, "force"))
        else:
            return False
        return True

    def _vector(self, tag: Tag, name: str) -> np.ndarray:
        child = tag.first(name) or Tag(name, tag.line)
        return self._curve(child) * np.array(self.file.numbers(child.text, child.line, 3))

    def _scaled(self, tag: Tag, name: str, default: float | None = None) -> float:
        """Return a number times its load curve."""
        child = tag.first(name)
        value = number(self.file, tag, name, default)
        return value if child is None else value * self._curve(child)

    def _curve(self, tag: Tag) -> float:
        """Return the load curve of a value at the end of the step; 1 without one."""
        key = tag.attributes.get("lc")
        if key is None:
            return 1.0
        curves = [c for data in self.root.all("LoadData") for c in data.children]
        curve = next((c for c in curves if c.attributes.get("id") == key), Tag("", 0))
        points = [self.file.numbers(p.text, p.line, 2) for p in _points(curve)]
        if not points:
            raise self.file.error(tag.line, f"load curve {key} is not there, or has no points")
        times, values = np.array(points).T
        end = times[-1] if self.end is None else self.end
        kind = curve.words("interpolate", curve.attributes.get("type", "linear")).lower()
        beyond = curve.words("extend", curve.attributes.get("extend", "constant")).lower()
        if not np.isclose(end, times[-1]) and (
            (end < times[-1] and kind not in ("linear", "loadcurve"))
            or (end > times[-1] and beyond != "constant")
        ):
            self.file.skip(curve.line, f"load curve {key} at time {end:g}: its last value is taken")
            end = times[-1]
        return float(np.interp(end, times, values))


def _points(curve: Tag) -> Iterator[Tag]:
    """Yield the points of a curve, in any of the formats."""
    for tag in (curve, *curve.all("points")):
        yield from tag.all("point", "pt", "loadpoint")
