"""Fibre and sheet rules for scene files; ``FIBRE_RULES`` is their registry.

A new rule is a frozen dataclass with a method ``directions``; its fields are the keys of the table
``[fibres]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.fibres import Axis, Depth, biventricular_depth, turned, wall_depth
from emulator.geometry.mesh import Mesh
from emulator.scenes.fibre_angles import FibreAngles, across_wall, without_parameters

Directions = tuple[np.ndarray, np.ndarray | None]
Angles = tuple[float | str, float | str]
"""Degrees, or names of parameters."""


class FibreRule(Protocol):
    """Fibres and sheets of a mesh; ``rule`` is its name in scene files."""

    rule: ClassVar[str]

    def directions(self, mesh: Mesh) -> Directions:
        """Unit fibres (m, 3), and unit sheets (m, 3) if the rule gives any.

        Angles that are parameters are zero.
        """
        ...

    def angles_in(self, mesh: Mesh) -> tuple[FibreAngles, ...]:
        """The rotations of these directions by parameters; none where the rule names none."""
        ...


@dataclass(frozen=True)
class Helix:
    """Helix angle that varies across the wall of one ventricle.

    Parameters
    ----------
    angles : degrees at endocardium and epicardium, or names of parameters.
    axis : from apex to base.
    sheet_angles : by which sheets are turned from the wall's normal about the fibres, likewise.
    endocardium, epicardium : facet sets.
    """

    rule: ClassVar[str] = "helix"

    angles: Angles
    axis: Axis = (0.0, 0.0, 1.0)
    endocardium: str = "endocardium"
    epicardium: str = "epicardium"
    sheet_angles: Angles = (0.0, 0.0)

    def directions(self, mesh: Mesh) -> Directions:
        """Fibres and sheets."""
        return _laid(self, self._wall(mesh))

    def angles_in(self, mesh: Mesh) -> tuple[FibreAngles, ...]:
        """The sheet angles and the helix angles that are parameters."""
        return _turning(self, self._wall(mesh))

    def _wall(self, mesh: Mesh) -> Depth:
        return wall_depth(mesh, (self.endocardium,), (self.epicardium,))


@dataclass(frozen=True)
class Biventricle:
    """Helix angle in both ventricles.

    Parameters
    ----------
    angles : degrees at endocardium and epicardium, or names of parameters.
    axis : from apex to base.
    sheet_angles : by which sheets are turned from the wall's normal about the fibres, likewise.
    """

    rule: ClassVar[str] = "biventricle"

    angles: Angles
    axis: Axis = (0.0, 0.0, 1.0)
    sheet_angles: Angles = (0.0, 0.0)

    def directions(self, mesh: Mesh) -> Directions:
        """Fibres and sheets."""
        return _laid(self, biventricular_depth(mesh))

    def angles_in(self, mesh: Mesh) -> tuple[FibreAngles, ...]:
        """The sheet angles and the helix angles that are parameters."""
        return _turning(self, biventricular_depth(mesh))


@dataclass(frozen=True)
class Uniform:
    """One direction everywhere.

    Parameters
    ----------
    direction : of the fibres, of any length above 0.
    sheets : sheet direction, likewise; for a law that takes any.
    angle : name of a parameter, degrees by which both are turned about ``about``.
    about : axis of that angle, of any length above 0.
    """

    rule: ClassVar[str] = "uniform"

    direction: Axis
    sheets: Axis | None = None
    angle: str | None = None
    about: Axis | None = None

    def __post_init__(self) -> None:
        if (self.angle is None) != (self.about is None):
            raise InputError("angle and about: give both, the parameter and the axis, or neither")
        for name in ("direction", "sheets", "about"):
            if (vector := getattr(self, name)) is not None and not np.linalg.norm(vector) > 0.0:
                raise InputError(f"{name} is zero; expected any length above 0")

    def directions(self, mesh: Mesh) -> Directions:
        """The directions, made unit length."""
        sheets = None if self.sheets is None else _everywhere(mesh, self.sheets)
        return _everywhere(mesh, self.direction), sheets

    def angles_in(self, mesh: Mesh) -> tuple[FibreAngles, ...]:
        """The angle, if it is a parameter."""
        if self.angle is None or self.about is None:
            return ()
        share = np.ones(len(mesh.elements))
        return (FibreAngles(_everywhere(mesh, self.about), {self.angle: share}),)


def _laid(rule: Helix | Biventricle, wall: Depth) -> Directions:
    """Directions in a wall; angles that are parameters are zero."""
    angles, sheet_angles = map(without_parameters, (rule.angles, rule.sheet_angles))
    return turned(wall, angles, rule.axis, sheet_angles)


def _turning(rule: Helix | Biventricle, wall: Depth) -> tuple[FibreAngles, ...]:
    """Rotations of these directions: of sheets about the fibres, then of both."""
    fibres = _laid(rule, wall)[0]
    return across_wall(wall.value, fibres, rule.sheet_angles) + across_wall(*wall, rule.angles)


def _everywhere(mesh: Mesh, vector: Axis) -> np.ndarray:
    """The unit vector along ``vector`` for every element (m, 3)."""
    return np.tile(np.asarray(vector) / np.linalg.norm(vector), (len(mesh.elements), 1))


FIBRE_RULES: dict[str, type[FibreRule]] = {
    rule.rule: rule for rule in (Helix, Biventricle, Uniform)
}
