"""Fibre and sheet rules for scene files; ``FIBRE_RULES`` is their registry.

A new rule is a frozen dataclass with the methods of :class:`FibreRule`; its fields are the keys of
the table ``[fibres]``.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol, override

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.fibres import Axis, Depth, biventricular_depth, turned, wall_depth
from emulator.geometry.mesh import Mesh
from emulator.scenes.tissue import FibreAngles

Directions = tuple[np.ndarray, np.ndarray | None]
Angles = tuple[float | str, float | str]
"""Angles on endocardium and epicardium, each in degrees or the name of a parameter."""


class FibreRule(Protocol):
    """Fibres and sheets of a mesh; ``rule`` is its name in scene files."""

    rule: ClassVar[str]

    def directions(self, mesh: Mesh) -> Directions:
        """Return unit fibres (m, 3), and unit sheets (m, 3) if the rule gives any.

        Angles that are parameters are zero.
        """
        ...

    def angles_in(self, mesh: Mesh) -> tuple[FibreAngles, ...]:
        """Return the rotations of these directions by parameters."""
        ...


@dataclass(frozen=True)
class WallRule:
    """Fibres whose helix angle varies across a wall, and sheets along the wall's normal.

    Parameters
    ----------
    angles : degrees at endocardium and epicardium, or names of parameters.
    axis : from apex to base.
    sheet_angles : by which sheets are turned from the wall's normal about the fibres, likewise.
    """

    angles: Angles
    axis: Axis = (0.0, 0.0, 1.0)
    sheet_angles: Angles = (0.0, 0.0)

    @abstractmethod
    def _wall(self, mesh: Mesh) -> Depth:
        """Return the relative depth in the wall, and its normal."""

    def directions(self, mesh: Mesh) -> Directions:
        """Return fibres and sheets."""
        angles, sheet_angles = (
            (0.0 if isinstance(inner, str) else inner, 0.0 if isinstance(outer, str) else outer)
            for inner, outer in (self.angles, self.sheet_angles)
        )
        return turned(self._wall(mesh), angles, self.axis, sheet_angles)

    def angles_in(self, mesh: Mesh) -> tuple[FibreAngles, ...]:
        """Return the rotations by parameters: of sheets about the fibres, then of both."""
        if not any(isinstance(angle, str) for angle in (*self.angles, *self.sheet_angles)):
            return ()
        wall, fibres = self._wall(mesh), self.directions(mesh)[0]
        return _rotation(wall.value, fibres, self.sheet_angles) + _rotation(*wall, self.angles)


@dataclass(frozen=True)
class Helix(WallRule):
    """Helix angle that varies across the wall of one ventricle.

    Parameters
    ----------
    endocardium, epicardium : facet sets of the wall.
    """

    rule: ClassVar[str] = "helix"

    endocardium: str = "endocardium"
    epicardium: str = "epicardium"

    @override
    def _wall(self, mesh: Mesh) -> Depth:
        return wall_depth(mesh, (self.endocardium,), (self.epicardium,))


@dataclass(frozen=True)
class Biventricle(WallRule):
    """Helix angle in both ventricles; facet sets lv_endocardium, rv_endocardium, epicardium."""

    rule: ClassVar[str] = "biventricle"

    @override
    def _wall(self, mesh: Mesh) -> Depth:
        return biventricular_depth(mesh)


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
        """Return the directions, made unit length."""
        return self.repeated(len(mesh.elements))[:2]

    def angles_in(self, mesh: Mesh) -> tuple[FibreAngles, ...]:
        """Return the rotation by the angle, where it is a parameter."""
        return self.repeated(len(mesh.elements))[2]

    def repeated(self, count: int) -> tuple[np.ndarray, np.ndarray | None, tuple[FibreAngles, ...]]:
        """Return fibres, sheets and rotations of ``count`` elements or states."""
        fibres, sheets, about = (
            None
            if vector is None
            else np.tile(np.asarray(vector) / np.linalg.norm(vector), (count, 1))
            for vector in (self.direction, self.sheets, self.about)
        )
        assert fibres is not None
        if self.angle is None or about is None:
            return fibres, sheets, ()
        return fibres, sheets, (FibreAngles(about, {self.angle: np.ones(count)}),)


def _rotation(depth: np.ndarray, axis: np.ndarray, angles: Angles) -> tuple[FibreAngles, ...]:
    """Return the rotation about ``axis`` (..., 3) by the ``angles`` that are parameters, if any."""
    shares: dict[str, np.ndarray] = {}
    for angle, share in zip(angles, (1.0 - depth, depth), strict=True):
        if isinstance(angle, str):
            shares[angle] = shares.get(angle, 0.0) + share
    return (FibreAngles(axis, shares),) if shares else ()


FIBRE_RULES: dict[str, type[FibreRule]] = {
    rule.rule: rule for rule in (Helix, Biventricle, Uniform)
}
