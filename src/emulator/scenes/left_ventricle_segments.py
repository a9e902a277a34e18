"""A human left ventricle whose stiffness differs from segment to segment."""

from __future__ import annotations

from dataclasses import replace

from emulator.geometry.heart_wall import SEGMENTS, aha_segments
from emulator.scenes.left_ventricle import HELIX, MYOCARDIUM, PRESSURE, left_ventricle
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene

STIFFNESSES = tuple(
    Parameter(f"stiffness_{label}", "", 0.5, 2.0, "log") for label in range(1, SEGMENTS + 1)
)
"""Half to twice the stiffness of healthy myocardium, whose factor is 1."""


def left_ventricle_segments(
    rings: int | None = None,
    around: int | None = None,
    layers: int | None = None,
    angles: tuple[float, float] = HELIX,
    kappa: float = 25.0,
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """:func:`~emulator.scenes.left_ventricle.left_ventricle` with a stiffness for each segment.

    theta = (stiffness_1, ..., stiffness_17, pressure). Each stiffness multiplies the energy of the
    law, except its ``kappa`` term, in one of the 17 segments (:mod:`emulator.geometry.heart_wall`).
    ``a``, ``b``, ``a_f`` and ``b_f`` are constants, the geometric means of their ranges in
    ``left_ventricle``.

    Parameters
    ----------
    rings, around, layers, angles, kappa, order, grading : as in ``left_ventricle``.
    """
    plain = left_ventricle(rings, around, layers, angles, kappa, order=order, grading=grading)
    centre = {p.name: float((p.low * p.high) ** 0.5) for p in MYOCARDIUM}
    return replace(
        plain,
        name="left_ventricle_segments",
        parameters=(*STIFFNESSES, PRESSURE),
        constants={**plain.constants, **centre},
        regions=aha_segments(plain.mesh),
        origin={**plain.origin, "scene": "left_ventricle_segments"},
    )
