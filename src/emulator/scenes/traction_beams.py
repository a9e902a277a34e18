"""Fibrous beams pulled aside at their end (Dalton et al. 2023, Appendix A)."""

from __future__ import annotations

import numpy as np

from emulator.mechanics.laws import find_law
from emulator.scenes.beams import BEAM_SIZES, Cells, beam_mesh
from emulator.scenes.left_ventricle import MYOCARDIUM
from emulator.scenes.loads import Traction
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

# Stiff fibres along a beam that bends: what is missing through its height shows first.
_SIZES = {1: BEAM_SIZES[1], 2: {"cells": (14, 2, 5), "grading": 2.0}}


def _beam(
    name: str,
    law: str,
    parameters: tuple[Parameter, ...],
    cells: Cells | None,
    traction: float,
    fibre_angle: float,
    kappa: float,
    order: int,
    grading: float | None,
) -> Scene:
    mesh, made = beam_mesh(cells, order, grading, ("left",), _SIZES)
    angle = np.radians(fibre_angle)
    return Scene(
        name=name,
        mesh=mesh,
        law=find_law(law),
        parameters=parameters,
        loads=(Traction("right", (0.0, 0.0, traction)),),
        supports=(Support("left"),),
        constants={"kappa": kappa},
        fibres=np.tile([np.cos(angle), np.sin(angle), 0.0], (len(mesh.elements), 1)),
        origin={
            "scene": name,
            **made,
            "traction": traction,
            "fibre_angle": fibre_angle,
            "kappa": kappa,
        },
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
    :func:`~emulator.scenes.left_ventricle.left_ventricle`. We had no access to the appendix: the
    dimensions are the paper's gravity beams'; traction, fibres and ``kappa`` are our choice.

    Parameters
    ----------
    cells : along x, y, z; by default what the elements' order needs.
    traction : along z on the free end, per reference area, kPa.
    fibre_angle : degrees from the beam's axis x towards y; any but 0 and 90 makes it twist.
    kappa : resistance to volume change, kPa.
    order, grading : of the elements, as in :func:`~emulator.scenes.beams.once_clamped_beam`.
    """
    name = "traction_beam_holzapfel_ogden"
    return _beam(
        name, "holzapfel_ogden", MYOCARDIUM, cells, traction, fibre_angle, kappa, order, grading
    )


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
    name = "traction_beam_guccione"
    return _beam(name, "guccione", parameters, cells, traction, fibre_angle, kappa, order, grading)
