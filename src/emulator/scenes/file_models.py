"""The tables of a scene file; see :mod:`emulator.scenes.file` for their meaning.

Loads, supports and fibre rules are read by the fields of the dataclasses in their registries.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from emulator.scenes.fibre_rules import FIBRE_RULES, FibreRule
from emulator.scenes.loads import LOADS, Load
from emulator.scenes.supports import SUPPORTS, BoundaryCondition
from emulator.schema import OneOf, Table


class Plane(Table):
    """Nodes or facets on the plane ``axis = at`` mm."""

    axis: Literal["x", "y", "z"]
    at: float


class ParameterTable(Table):
    """A quantity that varies."""

    unit: str = ""
    range: tuple[float, float]
    scale: Literal["log", "uniform"] = "uniform"


class SceneFile(Table):
    """A whole scene file."""

    law: str
    mesh: str
    parameters: dict[str, ParameterTable]
    supports: tuple[Annotated[BoundaryCondition, OneOf("kind", SUPPORTS, "held")], ...]
    loads: tuple[Annotated[Load, OneOf("kind", LOADS)], ...] = ()
    constants: dict[str, float] = Field(default_factory=dict)
    dilatation: Literal["pointwise", "mean"] = "pointwise"
    order: Literal[1, 2] | None = None
    regions: str | None = None
    fibres: Annotated[FibreRule, OneOf("rule", FIBRE_RULES)] | None = None
    node_sets: dict[str, Plane] = Field(default_factory=dict)
    facet_sets: dict[str, Plane] = Field(default_factory=dict)
