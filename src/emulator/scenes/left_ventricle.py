"""A human left ventricle filling in diastole (Dalton et al. 2023, Section 3.4)."""

from __future__ import annotations

from dataclasses import astuple

from emulator.geometry.bodies.ellipsoid import HUMAN, EllipsoidalWall, truncated_ellipsoid
from emulator.geometry.fibres import rule_based_fibres
from emulator.mechanics.laws import find_law
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

PRESSURE = Parameter("pressure", "kPa", 4.0 * KPA_PER_MMHG, 10.0 * KPA_PER_MMHG)
"""4 to 10 mmHg at the end of diastole, as in the paper."""

MYOCARDIUM = (
    Parameter("a", "kPa", 0.2, 0.52, "log"),
    Parameter("b", "", 1.0, 4.2, "log"),
    Parameter("a_f", "kPa", 3.0, 10.36, "log"),
    Parameter("b_f", "", 1.0, 4.46, "log"),
)
"""The paper's ranges, ``a`` and ``a_f`` doubled: it states them for the released form of the law
(see :func:`~emulator.mechanics.laws.holzapfel_ogden.textbook_from_released`)."""

HELIX = (60.0, -60.0)
"""Helix angle in degrees on the endocardium and on the epicardium. In the released fibre field the
median is 58 degrees in the innermost tenth of the wall and -46 in the outermost."""


def left_ventricle(
    rings: int = 15,
    around: int = 30,
    layers: int = 3,
    angles: tuple[float, float] = HELIX,
    kappa: float = 25.0,
    wall: tuple[float, float, float, float, float] = astuple(HUMAN),
    thicker: tuple[float, float] = (0.0, 0.0),
) -> Scene:
    """Holzapfel-Ogden ventricle under cavity pressure, its base held.

    theta = (a, b, a_f, b_f, pressure): the paper's law in textbook form, with the paper's ranges,
    on an idealised geometry. The pressure's work is exact, unlike in the released code.

    The default ``kappa`` is the released one. At the centre of the box it lets the wall's volume
    change by 1.0 %, at the soft corner by 2.1 %. Linear tetrahedra are too stiff in a thick wall,
    and more so the larger ``kappa``: at the centre the cavity grows by 45 mL on the default mesh,
    51 mL on one of 4145 nodes and 68 mL with quadratic elements and mean dilatation; with four
    times the ``kappa``, by 27 mL. Half the ``kappa`` would give 52 mL for twice the volume change.

    Parameters
    ----------
    rings, around, layers : of the mesh, as in
        :func:`~emulator.geometry.bodies.ellipsoid.truncated_ellipsoid`; the default has 1564 nodes.
    angles : helix angle in degrees on the endocardium and on the epicardium.
    kappa : resistance to volume change, kPa.
    wall : the dimensions of an :class:`~emulator.geometry.bodies.ellipsoid.EllipsoidalWall`, mm.
    thicker : by which fraction the wall is thicker at the base, and towards which angle in degrees.
    """
    mesh = truncated_ellipsoid(EllipsoidalWall(*wall), rings, around, layers, thicker=thicker)
    return Scene(
        name="left_ventricle",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=(*MYOCARDIUM, PRESSURE),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        constants={"kappa": kappa},
        fibres=rule_based_fibres(mesh, angles=angles),
        origin={
            "scene": "left_ventricle",
            "rings": rings,
            "around": around,
            "layers": layers,
            "angles": list(angles),
            "kappa": kappa,
            # Not written for the default wall, so that files of older releases stay equal.
            **({} if wall == astuple(HUMAN) else {"wall": list(wall)}),
            **({} if thicker == (0.0, 0.0) else {"thicker": list(thicker)}),
        },
    )
