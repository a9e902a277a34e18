"""Beams under gravity (Dalton et al. 2023, Section 3.1)."""

from __future__ import annotations

from dataclasses import replace

from emulator.geometry.bodies.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes.loads import Gravity, GravityVector
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.resolution import resolved
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

Cells = tuple[int, int, int]

_G = 9.80  # m/s2, as published
BEAM = (100.0, 10.0, 10.0)  # mm, as published
SIZES = {1: {"cells": (12, 4, 5)}, 2: {"cells": (20, 2, 2)}}
"""Cells along x, y, z by default."""


def _beam(name: str, cells: Cells | None, order: int, clamped: tuple[str, ...]) -> Scene:
    made = resolved(SIZES, order, cells=cells)
    return Scene(
        name=name,
        mesh=box(BEAM, **made),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("mu", "kPa", 50.0, 100.0, "log"),
            Parameter("lam", "kPa", 50.0, 100.0, "log"),
        ),
        loads=(Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=_G),),
        supports=tuple(Support(face) for face in clamped),
        origin={"scene": name, "cells": list(made["cells"]), "order": order},
    )


def once_clamped_beam(cells: Cells | None = None, order: int = 2) -> Scene:
    """A 100 x 10 x 10 mm beam held at its left end, bending under its own weight.

    Density 1 g/cm3 and g = 9.80 m/s2 as published; theta = (mu, lam), each 50 to 100 kPa.

    Parameters
    ----------
    cells : along x, y, z; by default what the elements' order needs.
    order : 2, quadratic elements; 1, linear ones as published, which lock: the tip of 12 x 4 x 5
        cells sinks by 38 mm instead of 59, at the centre of the box.
    """
    return _beam("once_clamped_beam", cells, order, ("left",))


def twice_clamped_beam(cells: Cells | None = None, order: int = 2) -> Scene:
    """The beam of :func:`once_clamped_beam`, held at both ends."""
    return _beam("twice_clamped_beam", cells, order, ("left", "right"))


def turned_beam(cells: Cells | None = None, order: int = 2) -> Scene:
    """The beam of :func:`once_clamped_beam`, turned between measurements.

    theta = (mu, lam, gravity_y, gravity_z): across the beam gravity may point anywhere. Along it
    there is none.
    """
    beam = _beam("turned_beam", cells, order, ("left",))
    across = tuple(Parameter(f"gravity_{axis}", "m/s2", -_G, _G) for axis in "yz")
    return replace(
        beam,
        parameters=(*beam.parameters, *across),
        loads=(GravityVector(density=1.0),),
        constants={"gravity_x": 0.0},
    )
