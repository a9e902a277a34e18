"""Two ventricles filling in diastole (Dalton et al. 2023, Appendix D)."""

from __future__ import annotations

from emulator.geometry import generators
from emulator.mechanics.laws import find_law
from emulator.scenes.fibre_rules import Biventricle
from emulator.scenes.left_ventricle import HELIX, MYOCARDIUM, PRESSURE
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure
from emulator.scenes.resolution import resolved
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

SIZES = {
    1: {"rings": 15, "around": 32, "layers": (3, 2), "grading": 1.0},
    2: {"rings": 12, "around": 24, "layers": (2, 2), "grading": 1.5},
}
"""Rings, nodes around, layers and grading of the mesh by default."""


def biventricle(
    rings: int | None = None,
    around: int | None = None,
    layers: tuple[int, int] | None = None,
    angles: tuple[float, float] = HELIX,
    kappa: float = 25.0,
    right_pressure: float = 2.0 * KPA_PER_MMHG,
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """Holzapfel-Ogden ventricles, each under its own cavity pressure, their base held.

    theta = (a, b, a_f, b_f, pressure), ranges and ``kappa`` as in
    :func:`~emulator.scenes.left_ventricle.left_ventricle`; ``pressure`` is the left ventricle's.
    We had no access to the appendix: the geometry is idealised, and the right pressure, 2 mmHg by
    default, is our choice; as in a healthy heart it is below every left pressure of the range.

    Parameters
    ----------
    rings, around, layers, grading : of the mesh, as in
        :func:`~emulator.geometry.generators.biventricle.biventricle`; by default what the elements'
        order needs.
    angles : helix angle in degrees on the endocardia and on the epicardium.
    kappa : resistance to volume change, kPa.
    right_pressure : in the right ventricle, kPa.
    order : of the elements; 1, linear, as published.
    """
    made = resolved(SIZES, order, rings=rings, around=around, layers=layers, grading=grading)
    mesh = generators.biventricle(**made)
    rule = Biventricle(angles)
    return Scene(
        name="biventricle",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=(*MYOCARDIUM, PRESSURE),
        loads=(
            CavityPressure("lv_endocardium"),
            CavityPressure("rv_endocardium", parameter="right_pressure"),
        ),
        supports=(Support("base"),),
        constants={"kappa": kappa, "right_pressure": right_pressure},
        fibres=rule.directions(mesh)[0],
        fibre_rule=rule,
        origin={
            "scene": "biventricle",
            **made,
            "layers": list(made["layers"]),
            "angles": list(angles),
            "kappa": kappa,
            "right_pressure": right_pressure,
        },
    )
