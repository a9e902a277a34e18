"""The tables of a scene file; see :mod:`emulator.scenes.file` for their meaning.

Loads, supports and fibre rules are read by the fields of the dataclasses in their registries.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from emulator.core.schema import OneOf, Table
from emulator.scenes.fibre_rules import FIBRE_RULES, FibreRule
from emulator.scenes.loads import LOADS, Load
from emulator.scenes.supports import SUPPORTS, BoundaryCondition


class Plane(Table):
    """Nodes or facets on the plane ``axis = at`` mm."""

    axis: Literal["x", "y", "z"]
    """the plane's normal."""
    at: float
    """its place on that axis, mm."""
    within: str | None = None
    """a node set of which only what is on the plane is taken, such as a face for its edge."""


class ParameterTable(Table):
    """A quantity that varies."""

    unit: str = ""
    """as law or load expect it, e.g. kPa; left out when dimensionless."""
    range: tuple[float, float]
    """lowest and highest value."""
    scale: Literal["log", "uniform"] = "uniform"
    """log to sample equal ratios equally."""


class BodyTable(Table):
    """One of several bodies of one material; its set ``top`` is ``name.top``."""

    name: str
    """of the body, and of the sets that its surface is; letters, digits, _ and -."""
    mesh: str
    """its mesh file, as ``mesh`` of a scene of one body."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """by how much it is moved, mm; bodies do not feel each other, but no nodes may coincide."""


class SceneFile(Table):
    """A whole scene file."""

    law: str
    """a hyperelastic law."""
    mesh: str | None = None
    """mesh file of tetrahedra in mm, any format meshio reads; its path is relative to this file."""
    bodies: tuple[BodyTable, ...] = ()
    """several bodies of one material, in place of mesh."""
    parameters: dict[str, ParameterTable]
    """what varies: parameters of the law, of loads and of regions."""
    supports: tuple[Annotated[BoundaryCondition, OneOf("kind", SUPPORTS, "held")], ...]
    """what holds the body; a table without a kind holds a node set."""
    loads: tuple[Annotated[Load, OneOf("kind", LOADS)], ...] = ()
    """what moves the body."""
    constants: dict[str, float] = Field(default_factory=dict)
    """parameters that do not vary, in the unit that law or load expect."""
    dilatation: Literal["pointwise", "mean", "patch"] = "pointwise"
    """mean: one volume ratio an element, so that quadratic tetrahedra do not lock; patch: one for
    about six linear ones, which then lock much less."""
    order: Literal[1, 2] | None = None
    """2 for quadratic tetrahedra, made from linear ones if need be; as the mesh file without it."""
    regions: str | None = None
    """cell data of the mesh file with a whole number for each tetrahedron, e.g. gmsh:physical; with
    several bodies also body: 1, 2, ... in their order."""
    fibres: Annotated[FibreRule, OneOf("rule", FIBRE_RULES)] | None = None
    """a rule for fibres and sheets; without it they come from the mesh file."""
    loaded_by: dict[str, str] = Field(default_factory=dict)
    """where the mesh is the shape under load, as of an image: for each load's parameter the name of
    the parameter or constant that holds its value there."""
    node_sets: dict[str, Plane] = Field(default_factory=dict)
    """node sets beside those of the mesh file."""
    facet_sets: dict[str, Plane] = Field(default_factory=dict)
    """facet sets beside those of the mesh file."""
