"""The tables of a scene file, and their JSON Schema for editors that complete and check TOML.

``docs/scene_files.md`` explains them. Loads, supports and fibre rules are read by the fields of the
dataclasses in their registries; the schema takes laws and units from the registry of laws.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from emulator.core.schema import OneOf, Table, json_schema
from emulator.mechanics.laws import LAWS, Law
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.fibre_rules import FIBRE_RULES, FibreRule
from emulator.scenes.loads import LOADS, Load
from emulator.scenes.scene_data import Dilatation
from emulator.scenes.supports import SUPPORTS, BoundaryCondition


class Plane(Table):
    """Nodes or facets on the plane ``axis = at`` mm, or between two such planes."""

    axis: Literal["x", "y", "z"]
    """the plane's normal."""
    at: float | tuple[float, float]
    """its coordinate on that axis, mm; or two, between which nodes are taken."""
    within: str | None = None
    """a node set; only its nodes on the plane are taken, such as the edge of a face."""


class ParameterTable(Table):
    """A quantity that varies, with a range or a log-normal prior."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [
        {"required": ["range"]},
        {"required": ["median", "log_sd"], "not": {"required": ["scale"]}},
    ]})  # fmt: skip

    unit: str = ""
    """as law or load expect it, e.g. kPa; left out when dimensionless."""
    range: tuple[float, float] | None = None
    """lowest and highest value."""
    scale: Literal["log", "uniform"] = "uniform"
    """log to sample equal ratios equally."""
    median: float | None = None
    """median of its prior, a log-normal, in place of range."""
    log_sd: float | None = None
    """sd of the prior's logarithm, about its relative sd; the range is one to each side."""
    source: str = ""
    """where the prior is from, in words."""


class BodyTable(Table):
    """One of several bodies of one material; its set ``top`` is ``name.top``."""

    name: str
    """of the body, and of the sets that its surface is; letters, digits, _ and -."""
    mesh: str
    """its mesh file."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """by how much it is moved, mm; bodies do not feel each other, but no nodes may coincide."""


class GripsTable(Table):
    """How a specimen was held, which tells what its grips do to the posterior."""

    size: tuple[float, float, float]
    """lengths of the piece between its grips along x, y and z, mm."""
    held: Literal["clamped", "hooks"] = "clamped"
    """clamped: faces that do not deform, in jaws or glued to plates; hooks: points of the edges."""
    hooks: int = 5
    """number of hooks of an edge."""
    cells: int = 8
    """number of elements along the longest side."""
    marks: float | None = None
    """side of the square in the middle in which stretches were measured, mm; left out where they
    are those of the grips."""
    learned: str | None = None
    """file of calibrate train, which adds what the grips do to the stresses; relative to this
    file."""


class TubeTable(Table):
    """The sector without stress that a tube opens to when it is cut."""

    inner_radius: float
    """inner radius of the sector, mm."""
    layers: tuple[float, ...]
    """thickness of each layer of the sector from the inside out, mm; in layer 2 the law's energy is
    multiplied by stiffness_2, and so on."""
    opening_angle: float = 0.0
    """angle that the sector lacks of a full turn, degrees; twice Fung's opening angle."""
    points: int = 5
    """number of points of a layer at which stresses are computed."""


class ViscosityTable(Table):
    """How the stress of a law relaxes: docs/viscosity.md."""

    kind: Literal["prony", "spectrum", "kelvin_voigt"] = "prony"
    """prony: relaxation_1 and tau_1 (s), and so on for each term; spectrum: Fung's continuous one,
    with spectrum, tau_1 and tau_2 (s); kelvin_voigt: of a body, eta (kPa s) times the strain's
    rate."""
    terms: int | None = None
    """number of terms, 1 by default; of points of a spectrum, 16 by default."""


class InertiaTable(Table):
    """The mass of a body that goes through time: docs/viscosity.md."""

    density: float = 1.05
    """mass density in g/cm3."""
    spectral_radius: float = 0.8
    """share of the fastest vibrations that a time step leaves, 0 to 1."""


class SceneFile(Table):
    """A whole scene file."""

    law: str
    """a hyperelastic law."""
    mesh: str | None = None
    """mesh file of tetrahedra in mm, any format meshio reads; its path is relative to this file."""
    bodies: tuple[BodyTable, ...] = ()
    """several bodies of one material, in place of mesh."""
    specimen: str | None = None
    """in place of mesh, a table (CSV or spreadsheet) of the states of a tested specimen, relative
    to this file: docs/specimens.md."""
    grips: GripsTable | Literal["none"] | None = None
    """how the specimen was held; "none" where its grips are far from what was measured. Without it,
    the verdict says that nobody told."""
    tube: TubeTable | None = None
    """of a specimen that is a tube, whose table has radii and stretch_axial."""
    viscosity: ViscosityTable | None = None
    """of a specimen whose table has a column time (s), or of a body, which then has a parameter
    time; without it, both are elastic."""
    inertia: InertiaTable | None = None
    """of a body that goes through time; without it, it has no mass."""
    history: str | None = None
    """of a body that goes through time, a table (CSV or spreadsheet) of its times and loads,
    relative to this file; then time and these loads are no parameters: docs/viscosity.md."""
    parameters: dict[str, ParameterTable]
    """what varies: parameters of the law, of loads and of the stiffness."""
    supports: tuple[Annotated[BoundaryCondition, OneOf("kind", SUPPORTS, "held")], ...] = ()
    """what holds the body; a table without a kind holds a node set. A specimen has none."""
    loads: tuple[Annotated[Load, OneOf("kind", LOADS)], ...] = ()
    """what moves the body."""
    constants: dict[str, float] = Field(default_factory=dict)
    """parameters that do not vary, in the unit that law or load expect."""
    dilatation: Dilatation = "pointwise"
    """mean: one volume ratio an element, so that quadratic tetrahedra do not lock; patch: one for
    about six linear ones, which then lock much less."""
    order: Literal[1, 2] | None = None
    """2 for quadratic tetrahedra, made from linear ones if need be; as the mesh file without it."""
    regions: str | None = None
    """cell data of the mesh file with a whole number for each tetrahedron, e.g. gmsh:physical; with
    several bodies also body: 1, 2, ... in their order."""
    stiffness_modes: str | None = None
    """cell data of the mesh file with k numbers for each tetrahedron: the change of the logarithm
    of the stiffness for a size of 1 of each mode; sizes are stiffness_mode_1 to k."""
    fibres: Annotated[FibreRule, OneOf("rule", FIBRE_RULES)] | None = None
    """a rule for fibres and sheets; without it they come from the mesh file."""
    loaded_by: dict[str, str] = Field(default_factory=dict)
    """where the mesh is the shape under load, as of an image: for each parameter of a load the name
    of the parameter or constant that holds its value there."""
    node_sets: dict[str, Plane] = Field(default_factory=dict)
    """node sets beside those of the mesh file."""
    facet_sets: dict[str, Plane] = Field(default_factory=dict)
    """facet sets beside those of the mesh file."""


def scene_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of scene files, without the sets of the mesh."""
    schema = json_schema(SceneFile)
    keys = schema["properties"]
    keys["law"] |= {
        "enum": list(LAWS),
        "x-taplo": {"docs": {"enumValues": [_law_inputs(law) for law in LAWS.values()]}},
    }
    varied = keys["parameters"]["additionalProperties"]
    texts = _texts()
    keys["parameters"]["properties"] = {
        name: {**varied, "description": text} for name, text in texts.items()
    }
    keys["constants"]["properties"] = {
        name: {"type": "number", "description": text} for name, text in texts.items()
    }
    held = [{"required": [key, "supports"]} for key in ("mesh", "bodies")]
    one_mesh = {"oneOf": [*held, {"required": ["specimen"], "not": {"required": ["supports"]}}]}
    units = [_units(law) for law in LAWS.values()]
    return {"title": "Scene file", **schema, "allOf": [one_mesh, *units]}


def _law_inputs(law: Law) -> str:
    """Return the parameters of a law with their units, and the directions it needs."""
    needed_directions = [name for name in ("fibres", "sheets") if getattr(law, name)]
    directions = f"; needs {' and '.join(needed_directions)}" if needed_directions else ""
    return ", ".join(map(_with_unit, law.quantities)) + directions


def _with_unit(quantity: Quantity) -> str:
    return f"{quantity.name} ({quantity.unit})" if quantity.unit else quantity.name


def _texts() -> dict[str, str]:
    """Return the unit and the laws of every parameter that some law has, by its name."""
    takers: dict[str, dict[str, list[str]]] = {}
    for law in LAWS.values():
        for quantity in law.quantities:
            takers.setdefault(quantity.name, {}).setdefault(quantity.unit, []).append(law.name)
    return {
        name: "; ".join(f"{unit or 'dimensionless'}, of {', '.join(of)}" for unit, of in by.items())
        for name, by in takers.items()
    }


def _units(law: Law) -> dict[str, Any]:
    """Return the rule that a file gives the units of this law's parameters, and no others."""
    parameters = {}
    for quantity in law.quantities:
        unit = {"properties": {"unit": {"const": quantity.unit}}}
        parameters[quantity.name] = {**unit, "required": ["unit"]} if quantity.unit else unit
    return {
        "if": {"properties": {"law": {"const": law.name}}, "required": ["law"]},
        "then": {"properties": {"parameters": {"properties": parameters}}},
    }
