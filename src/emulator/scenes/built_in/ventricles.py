"""Ventricles that fill in diastole (Dalton et al. 2023, Section 3.4, Appendices C and D)."""

from __future__ import annotations

from dataclasses import astuple, replace

from emulator.geometry import generators
from emulator.geometry.generators.body import resolved
from emulator.geometry.generators.ellipsoid import (
    HUMAN,
    EllipsoidalWall,
    human_ventricle,
    truncated_ellipsoid,
)
from emulator.geometry.heart_wall import SEGMENTS, aha_segments
from emulator.mechanics.laws import find_law
from emulator.scenes.fibre_rules import Biventricle, Helix
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

# Default sizes by the order of the elements, for 1564 linear nodes or 4627 quadratic ones.
_SIZES = {
    1: {"rings": 15, "around": 30, "layers": 3, "grading": 1.0},
    2: {"rings": 8, "around": 28, "layers": 3, "grading": 1.5},
}
_BIVENTRICLE_SIZES = {
    1: {"rings": 15, "around": 32, "layers": (3, 2), "grading": 1.0},
    2: {"rings": 12, "around": 24, "layers": (2, 2), "grading": 1.5},
}


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
    rings, around, layers, grading : the resolution of the mesh, as in
        :func:`~emulator.geometry.generators.ellipsoid.truncated_ellipsoid`; by default what the
        elements' order needs.
    angles : the helix angle on the endocardium and on the epicardium, in degrees, or the name of a
        parameter, which then varies within 20 degrees of ``HELIX``.
    kappa : the resistance to volume change, kPa.
    wall : dimensions in mm of an :class:`~emulator.geometry.generators.ellipsoid.EllipsoidalWall`.
    thicker : by which fraction the wall is thicker at the base, and towards which angle in degrees.
    order : 2, quadratic elements with a fibre at each of their four points; 1, linear ones as
        published, whose cavity grows by a quarter too little.
    """
    sizes = resolved(_SIZES, order, rings=rings, around=around, layers=layers, grading=grading)
    mesh = truncated_ellipsoid(EllipsoidalWall(*wall), **sizes, thicker=thicker)
    rule = Helix(angles)
    return Scene(
        name="left_ventricle",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=(*MYOCARDIUM, *_angle_parameters(angles), PRESSURE),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        constants={"kappa": kappa},
        fibres=rule.directions(mesh)[0],
        fibre_rule=rule,
        angles=rule.angles_in(mesh),
        origin={
            "scene": "left_ventricle",
            **sizes,
            "angles": list(angles),
            "kappa": kappa,
            # Not written for the default wall, so that files of older releases stay equal.
            **({} if wall == astuple(HUMAN) else {"wall": list(wall)}),
            **({} if thicker == (0.0, 0.0) else {"thicker": list(thicker)}),
        },
    )


def left_ventricle_neo_hookean(
    rings: int | None = None,
    around: int | None = None,
    layers: int | None = None,
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """Neo-Hookean ventricle under cavity pressure, its base held, without fibres.

    theta = (mu, lam, pressure). Geometry as in :func:`left_ventricle`. We had no access to the
    appendix: the ranges, ``mu`` 4 to 12 kPa and ``lam`` 40 to 120 kPa, are our choice.

    Parameters
    ----------
    rings, around, layers, order, grading : the resolution, as in ``left_ventricle``.
    """
    sizes = resolved(_SIZES, order, rings=rings, around=around, layers=layers, grading=grading)
    return Scene(
        name="left_ventricle_neo_hookean",
        mesh=human_ventricle(**sizes),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("mu", "kPa", 4.0, 12.0, "log"),
            Parameter("lam", "kPa", 40.0, 120.0, "log"),
            PRESSURE,
        ),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        origin={"scene": "left_ventricle_neo_hookean", **sizes},
    )


def left_ventricle_segments(
    rings: int | None = None,
    around: int | None = None,
    layers: int | None = None,
    angles: tuple[float, float] = HELIX,
    kappa: float = 25.0,
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """:func:`left_ventricle` with a stiffness for each segment.

    theta = (stiffness_1, ..., stiffness_17, pressure). Each stiffness multiplies the energy of the
    law, except its ``kappa`` term, in one of the 17 segments (:mod:`emulator.geometry.heart_wall`).
    ``a``, ``b``, ``a_f`` and ``b_f`` are constants, the geometric means of their ranges in
    ``left_ventricle``.

    Parameters
    ----------
    rings, around, layers, angles, kappa, order, grading : as in ``left_ventricle``.
    """
    labels = range(1, SEGMENTS + 1)
    # Half to twice the stiffness of healthy myocardium, whose factor is 1.
    stiffnesses = tuple(Parameter(f"stiffness_{k}", "", 0.5, 2.0, "log") for k in labels)
    plain = left_ventricle(rings, around, layers, angles, kappa, order=order, grading=grading)
    centre = {p.name: float((p.low * p.high) ** 0.5) for p in MYOCARDIUM}
    return replace(
        plain,
        name="left_ventricle_segments",
        parameters=(*stiffnesses, PRESSURE),
        constants={**plain.constants, **centre},
        regions=aha_segments(plain.mesh),
        origin={**plain.origin, "scene": "left_ventricle_segments"},
    )


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

    theta = (a, b, a_f, b_f, pressure), ranges and ``kappa`` as in :func:`left_ventricle`;
    ``pressure`` is the left ventricle's. We had no access to the appendix: the geometry is
    idealised, and the right pressure, 2 mmHg by default, is our choice; as in a healthy heart it is
    below every left pressure of the range.

    Parameters
    ----------
    rings, around, layers, grading : the resolution of the mesh, as in
        :func:`~emulator.geometry.generators.biventricle.biventricle`; by default what the elements'
        order needs.
    angles : the helix angle in degrees on the endocardia and on the epicardium.
    kappa : the resistance to volume change, kPa.
    right_pressure : the pressure in the right ventricle, kPa.
    order : the order of the elements; 1, linear, as published.
    """
    mesh_sizes = {"rings": rings, "around": around, "layers": layers, "grading": grading}
    sizes = resolved(_BIVENTRICLE_SIZES, order, **mesh_sizes)
    mesh = generators.biventricle(**sizes)
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
            **sizes,
            "layers": list(sizes["layers"]),
            "angles": list(angles),
            "kappa": kappa,
            "right_pressure": right_pressure,
        },
    )


def _angle_parameters(angles: tuple[float | str, float | str]) -> tuple[Parameter, ...]:
    """Return the parameters of helix angles that are names, each once."""
    centres = {name: at for name, at in zip(angles, HELIX, strict=True) if isinstance(name, str)}
    return tuple(Parameter(name, "deg", at - 20.0, at + 20.0) for name, at in centres.items())
