"""Fibre and sheet rules for scene files; ``FIBRE_RULES`` is their registry.

A new rule is a frozen dataclass with a method ``directions``; its fields are the keys of the table
``[fibres]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from emulator.errors import InputError
from emulator.geometry.fibres import (
    Angles,
    Axis,
    biventricular_directions,
    rule_based_directions,
)
from emulator.geometry.mesh import Mesh

Directions = tuple[np.ndarray, np.ndarray | None]


class FibreRule(Protocol):
    """Fibres and sheets of a mesh; ``rule`` is its name in scene files."""

    rule: ClassVar[str]

    def directions(self, mesh: Mesh) -> Directions:
        """Unit fibres (m, 3), and unit sheets (m, 3) if the rule gives any."""
        ...


@dataclass(frozen=True)
class Helix:
    """Helix angle that varies across the wall of one ventricle.

    Parameters
    ----------
    angles : degrees at endocardium and epicardium.
    axis : from apex to base.
    endocardium, epicardium : facet sets.
    """

    rule: ClassVar[str] = "helix"

    angles: Angles
    axis: Axis = (0.0, 0.0, 1.0)
    endocardium: str = "endocardium"
    epicardium: str = "epicardium"

    def directions(self, mesh: Mesh) -> Directions:
        """Fibres, and the transmural direction as sheets."""
        return rule_based_directions(
            mesh, self.endocardium, self.epicardium, self.angles, self.axis
        )


@dataclass(frozen=True)
class Biventricle:
    """Helix angle in both ventricles.

    Parameters
    ----------
    angles : degrees at endocardium and epicardium.
    axis : from apex to base.
    """

    rule: ClassVar[str] = "biventricle"

    angles: Angles
    axis: Axis = (0.0, 0.0, 1.0)

    def directions(self, mesh: Mesh) -> Directions:
        """Fibres, and the transmural direction as sheets."""
        return biventricular_directions(mesh, self.angles, self.axis)


@dataclass(frozen=True)
class Uniform:
    """One direction everywhere.

    Parameters
    ----------
    direction : of the fibres, of any length above 0.
    sheets : sheet direction, likewise; for a law that takes any.
    """

    rule: ClassVar[str] = "uniform"

    direction: Axis
    sheets: Axis | None = None

    def __post_init__(self) -> None:
        for name in ("direction", "sheets"):
            if (vector := getattr(self, name)) is not None and not np.linalg.norm(vector) > 0.0:
                raise InputError(f"{name} is zero; expected any length above 0")

    def directions(self, mesh: Mesh) -> Directions:
        """The directions, made unit length."""
        sheets = None if self.sheets is None else _everywhere(mesh, self.sheets)
        return _everywhere(mesh, self.direction), sheets


def _everywhere(mesh: Mesh, vector: Axis) -> np.ndarray:
    """The unit vector along ``vector`` for every element (m, 3)."""
    return np.tile(np.asarray(vector) / np.linalg.norm(vector), (len(mesh.elements), 1))


FIBRE_RULES: dict[str, type[FibreRule]] = {
    rule.rule: rule for rule in (Helix, Biventricle, Uniform)
}
