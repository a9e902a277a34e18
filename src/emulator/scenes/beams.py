"""Beams under gravity (Dalton et al. 2023, Section 3.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from emulator.geometry.generators.box import box, toward_ends
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import find_law
from emulator.scenes.loads import Gravity, GravityVector
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.resolution import resolved
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

Cells = tuple[int, int, int]

_G = 9.80  # m/s2, as published
BEAM = (100.0, 10.0, 10.0)  # mm, as published
BEAM_SIZES = {
    1: {"cells": (12, 4, 5), "grading": 1.0},
    2: {"cells": (20, 2, 2), "grading": 1.5},
}


def beam_mesh(
    cells: Cells | None,
    order: int,
    grading: float | None,
    clamped: tuple[str, ...],
    sizes: Mapping[int, Mapping[str, Any]] = BEAM_SIZES,
) -> tuple[Mesh, dict[str, object]]:
    """A beam whose cells are shorter at its clamps, and the sizes that it was made with.

    An edge that is clamped is a singularity; at the same number of nodes as even cells, cells that
    are shorter there are a third as far from the limit (``studies/elements``).
    """
    made = resolved(sizes, order, cells=cells, grading=grading)
    along = toward_ends(made["cells"][0], made["grading"], clamped)
    mesh = box(BEAM, made["cells"], order, along)
    return mesh, {**made, "cells": list(made["cells"])}


def _beam(
    name: str, cells: Cells | None, order: int, grading: float | None, clamped: tuple[str, ...]
) -> Scene:
    mesh, made = beam_mesh(cells, order, grading, clamped)
    return Scene(
        name=name,
        mesh=mesh,
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("mu", "kPa", 50.0, 100.0, "log"),
            Parameter("lam", "kPa", 50.0, 100.0, "log"),
        ),
        loads=(Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=_G),),
        supports=tuple(Support(face) for face in clamped),
        origin={"scene": name, **made},
    )


def once_clamped_beam(
    cells: Cells | None = None, order: int = 2, grading: float | None = None
) -> Scene:
    """A 100 x 10 x 10 mm beam held at its left end, bending under its own weight.

    Density 1 g/cm3 and g = 9.80 m/s2 as published; theta = (mu, lam), each 50 to 100 kPa.

    Parameters
    ----------
    cells : along x, y, z; by default what the elements' order needs.
    order : 2, quadratic elements; 1, linear ones as published, which lock: the tip of 12 x 4 x 5
        cells sinks by 38 mm instead of 59, at the centre of the box.
    grading : 1 for even cells, more for cells that are shorter at the clamp, see
        :func:`~emulator.geometry.generators.box.toward_ends`.
    """
    return _beam("once_clamped_beam", cells, order, grading, ("left",))


def twice_clamped_beam(
    cells: Cells | None = None, order: int = 2, grading: float | None = None
) -> Scene:
    """The beam of :func:`once_clamped_beam`, held at both ends."""
    return _beam("twice_clamped_beam", cells, order, grading, ("left", "right"))


def turned_beam(cells: Cells | None = None, order: int = 2, grading: float | None = None) -> Scene:
    """The beam of :func:`once_clamped_beam`, turned between measurements.

    theta = (mu, lam, gravity_y, gravity_z): across the beam gravity may point anywhere. Along it
    there is none.
    """
    beam = _beam("turned_beam", cells, order, grading, ("left",))
    across = tuple(Parameter(f"gravity_{axis}", "m/s2", -_G, _G) for axis in "yz")
    return replace(
        beam,
        parameters=(*beam.parameters, *across),
        loads=(GravityVector(density=1.0),),
        constants={"gravity_x": 0.0},
    )
