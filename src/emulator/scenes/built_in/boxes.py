"""Beams and a twisted cube (Dalton et al. 2023, Sections 3.1 and 3.2, Appendix A).

Beams bend under gravity; fibrous ones under traction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from emulator.geometry.generators.body import resolved
from emulator.geometry.generators.box import box, toward_ends
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import find_law
from emulator.scenes.built_in.ventricles import MYOCARDIUM
from emulator.scenes.loads import Gravity, GravityVector, Traction
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

Cells = tuple[int, int, int]

_G = 9.80  # m/s2, as published
_BEAM = (100.0, 10.0, 10.0)  # mm, as published
_SIZES = {1: {"cells": (12, 4, 5), "grading": 1.0}, 2: {"cells": (20, 2, 2), "grading": 1.5}}
# Stiff fibres along a beam that bends need more cells through the height.
_FIBROUS_SIZES = {1: _SIZES[1], 2: {"cells": (14, 2, 5), "grading": 2.0}}


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
    return _gravity_beam("once_clamped_beam", cells, order, grading, ("left",))


def twice_clamped_beam(
    cells: Cells | None = None, order: int = 2, grading: float | None = None
) -> Scene:
    """The beam of :func:`once_clamped_beam`, held at both ends."""
    return _gravity_beam("twice_clamped_beam", cells, order, grading, ("left", "right"))


def turned_beam(cells: Cells | None = None, order: int = 2, grading: float | None = None) -> Scene:
    """The beam of :func:`once_clamped_beam`, turned between measurements.

    theta = (mu, lam, gravity_y, gravity_z): across the beam gravity may point anywhere. Along it
    there is none.
    """
    beam = _gravity_beam("turned_beam", cells, order, grading, ("left",))
    across = tuple(Parameter(f"gravity_{axis}", "m/s2", -_G, _G) for axis in "yz")
    return replace(
        beam,
        parameters=(*beam.parameters, *across),
        loads=(GravityVector(density=1.0),),
        constants={"gravity_x": 0.0},
    )


def traction_beam_holzapfel_ogden(
    cells: Cells | None = None,
    traction: float = 0.01,
    fibre_angle: float = 0.0,
    kappa: float = 25.0,
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """A 100 x 10 x 10 mm Holzapfel-Ogden beam, one end held, the other pulled up.

    theta = (a, b, a_f, b_f) with the ranges of
    :func:`~emulator.scenes.built_in.ventricles.left_ventricle`. We had no access to the appendix:
    the dimensions are the paper's gravity beams'; traction, fibres and ``kappa`` are our choice.

    Parameters
    ----------
    cells : along x, y, z; by default what the elements' order needs.
    traction : along z on the free end, per reference area, kPa.
    fibre_angle : degrees from the beam's axis x towards y; any but 0 and 90 makes it twist.
    kappa : resistance to volume change, kPa.
    order, grading : of the elements, as in :func:`once_clamped_beam`.
    """
    origin = {"traction": traction, "fibre_angle": fibre_angle, "kappa": kappa}
    return _traction_beam("holzapfel_ogden", MYOCARDIUM, cells, order, grading, origin)


def traction_beam_guccione(
    cells: Cells | None = None,
    traction: float = 0.02,
    fibre_angle: float = 0.0,
    kappa: float = 50.0,
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """A 100 x 10 x 10 mm Guccione beam, one end held, the other pulled up.

    theta = (C, b_f, b_t, b_fs), from half to twice the 2 kPa, 8, 2 and 4 of the benchmark beam in
    Land et al. (2015). We had no access to the appendix: the dimensions are the paper's gravity
    beams'; ranges, traction, fibres and ``kappa`` are our choice.

    Parameters
    ----------
    cells, traction, fibre_angle, kappa, order, grading : as in
        :func:`traction_beam_holzapfel_ogden`.
    """
    parameters = (
        Parameter("C", "kPa", 1.0, 4.0, "log"),
        Parameter("b_f", "", 4.0, 16.0, "log"),
        Parameter("b_t", "", 1.0, 4.0, "log"),
        Parameter("b_fs", "", 2.0, 8.0, "log"),
    )
    origin = {"traction": traction, "fibre_angle": fibre_angle, "kappa": kappa}
    return _traction_beam("guccione", parameters, cells, order, grading, origin)


def _gravity_beam(
    name: str, cells: Cells | None, order: int, grading: float | None, clamped: tuple[str, ...]
) -> Scene:
    mesh, sizes = _mesh(cells, order, grading, clamped, _SIZES)
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
        origin={"scene": name, **sizes},
    )


def _traction_beam(
    law: str,
    parameters: tuple[Parameter, ...],
    cells: Cells | None,
    order: int,
    grading: float | None,
    origin: dict[str, float],
) -> Scene:
    mesh, sizes = _mesh(cells, order, grading, ("left",), _FIBROUS_SIZES)
    angle, name = np.radians(origin["fibre_angle"]), f"traction_beam_{law}"
    return Scene(
        name=name,
        mesh=mesh,
        law=find_law(law),
        parameters=parameters,
        loads=(Traction("right", (0.0, 0.0, origin["traction"])),),
        supports=(Support("left"),),
        constants={"kappa": origin["kappa"]},
        fibres=np.tile([np.cos(angle), np.sin(angle), 0.0], (len(mesh.elements), 1)),
        origin={"scene": name, **sizes, **origin},
    )


def _mesh(
    cells: Cells | None,
    order: int,
    grading: float | None,
    clamped: tuple[str, ...],
    defaults: Mapping[int, Mapping[str, Any]],
) -> tuple[Mesh, dict[str, Any]]:
    """Return a beam whose cells are shorter at its clamps, and its sizes by name.

    An edge that is clamped is a singularity. With as many nodes as even cells, cells that are
    shorter there are a third as far from the limit.
    """
    sizes = resolved(defaults, order, cells=cells, grading=grading)
    along = toward_ends(sizes["cells"][0], sizes["grading"], clamped)
    return box(_BEAM, sizes["cells"], order, along), {**sizes, "cells": list(sizes["cells"])}


def twisting_cube(
    cells: int | None = None, edge: float = 10.0, degrees: float = 60.0, order: int = 2
) -> Scene:
    """A cube clamped at its left face, its right face twisted about the x axis.

    Each point of the right face moves halfway along the chord of a rigid rotation by ``degrees``,
    as published. theta = (E, nu), 1 to 25 kPa, 0.1 to 0.4.

    Parameters
    ----------
    cells : the number of cells along each edge; the default depends on the order.
    edge : the length of an edge, mm.
    degrees : the angle of the rotation whose half chord is prescribed.
    order : the order of the elements; 1 as published.
    """
    count = resolved({1: {"cells": 6}, 2: {"cells": 4}}, order, cells=cells)["cells"]
    sizes = {"cells": count, "edge": edge, "degrees": degrees, "order": order}
    mesh = box((edge,) * 3, (count,) * 3, order)
    right = mesh.nodes[mesh.node_set("right")]
    displacement = 0.5 * twist(right, np.full(3, edge / 2.0), degrees)
    return Scene(
        name="twisting_cube",
        mesh=mesh,
        law=find_law("neo_hookean_E_nu"),
        parameters=(Parameter("E", "kPa", 1.0, 25.0, "log"), Parameter("nu", "", 0.1, 0.4, "log")),
        supports=(Support("left"), Support("right", displacement)),
        origin={"scene": "twisting_cube", **sizes},
    )


def twist(points: np.ndarray, centre: np.ndarray, degrees: float) -> np.ndarray:
    """Return the displacement (k, 3) of a rigid rotation of ``points`` (k, 3) mm by ``degrees``.

    The axis of rotation is parallel to x, through ``centre`` (3,).
    """
    angle = np.deg2rad(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    displacement = np.zeros_like(points)
    arm = points[:, 1:] - centre[1:]
    displacement[:, 1:] = arm @ rotation.T - arm
    return displacement
