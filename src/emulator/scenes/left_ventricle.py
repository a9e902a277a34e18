"""A human left ventricle filling in diastole (Dalton et al. 2023, Section 3.4)."""

from __future__ import annotations

from dataclasses import astuple

from emulator.geometry.generators.ellipsoid import HUMAN, EllipsoidalWall, truncated_ellipsoid
from emulator.mechanics.laws import find_law
from emulator.scenes.fibre_rules import Helix
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.resolution import resolved
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

SIZES = {
    1: {"rings": 15, "around": 30, "layers": 3, "grading": 1.0},
    2: {"rings": 8, "around": 28, "layers": 3, "grading": 1.5},
}
"""Mesh by default, as in :func:`~emulator.geometry.generators.ellipsoid.truncated_ellipsoid`: 1564
linear nodes, 4627 quadratic ones."""


def left_ventricle(
    rings: int | None = None,
    around: int | None = None,
    layers: int | None = None,
    angles: tuple[float | str, float | str] = HELIX,
    kappa: float = 25.0,
    wall: tuple[float, float, float, float, float] = astuple(HUMAN),
    thicker: tuple[float, float] = (0.0, 0.0),
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """Holzapfel-Ogden ventricle under cavity pressure, its base held.

    theta = (a, b, a_f, b_f, pressure): the paper's law in textbook form, with the paper's ranges,
    on an idealised geometry. The pressure's work is exact, unlike in the released code.

    The default ``kappa`` is the released one. At the centre of the box it lets the wall's volume
    change by 1.0 %, at the soft corner by 2.1 %.

    Parameters
    ----------
    rings, around, layers, grading : of the mesh, as in
        :func:`~emulator.geometry.generators.ellipsoid.truncated_ellipsoid`; by default what the
        elements' order needs.
    angles : helix angle on the endocardium and on the epicardium, in degrees, or the name of a
        parameter, which then varies within 20 degrees of ``HELIX``.
    kappa : resistance to volume change, kPa.
    wall : the dimensions of an :class:`~emulator.geometry.generators.ellipsoid.EllipsoidalWall`,
    mm.
    thicker : by which fraction the wall is thicker at the base, and towards which angle in degrees.
    order : 2, quadratic elements with a fibre at each of their four points; 1, linear ones as
        published, whose cavity grows by a quarter too little (``studies/elements``).
    """
    made = resolved(SIZES, order, rings=rings, around=around, layers=layers, grading=grading)
    mesh = truncated_ellipsoid(EllipsoidalWall(*wall), **made, thicker=thicker)
    rule = Helix(angles)
    return Scene(
        name="left_ventricle",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=(*MYOCARDIUM, *_varied(angles), PRESSURE),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        constants={"kappa": kappa},
        fibres=rule.directions(mesh)[0],
        fibre_rule=rule,
        angles=rule.angles_in(mesh),
        origin={
            "scene": "left_ventricle",
            **made,
            "angles": list(angles),
            "kappa": kappa,
            # Not written for the default wall, so that files of older releases stay equal.
            **({} if wall == astuple(HUMAN) else {"wall": list(wall)}),
            **({} if thicker == (0.0, 0.0) else {"thicker": list(thicker)}),
        },
    )


def _varied(angles: tuple[float | str, float | str]) -> tuple[Parameter, ...]:
    """Parameters of the helix angles that are names, each once."""
    named = {name: at for name, at in zip(angles, HELIX, strict=True) if isinstance(name, str)}
    return tuple(Parameter(name, "deg", at - 20.0, at + 20.0) for name, at in named.items())
