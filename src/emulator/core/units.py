"""Units of columns and words, with the factors to the project's own: mm, kPa, mN and mL.

Names of units are matched as they are written, then whatever their case: ``KPa`` is kPa. A name
that begins with a small m is not: ``mPa`` is neither MPa nor Pa.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from emulator.core.errors import InputError

_WITH_UNIT = re.compile(r"([^\[(]*[^\[( ]) *(?:[\[(] *([^\])]*?) *[\])])?")
KPA_PER_MMHG, MM3_PER_ML = 0.133322, 1000.0

IN_KPA = {
    "kPa": 1.0, "Pa": 1e-3, "MPa": 1e3, "N/mm2": 1e3, "N/cm2": 10.0, "N/m2": 1e-3, "mN/mm2": 1.0,
    "kN/m2": 1.0, "mmHg": KPA_PER_MMHG, "psi": 6.894757, "lbf/in2": 6.894757, "kgf/cm2": 98.0665,
    "gf/cm2": 0.0980665, "g/cm2": 0.0980665, "bar": 100.0, "dyn/cm2": 1e-4, "cmH2O": 0.0980665,
}  # fmt: skip
"""Stresses and pressures."""
IN_MN = {"mN": 1.0, "N": 1e3, "g": 9.80665, "gf": 9.80665, "kgf": 9806.65, "kN": 1e6}
"""Forces."""
IN_MM = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "µm": 1e-3}
"""Lengths."""
IN_MM2 = {"mm2": 1.0, "cm2": 100.0, "m2": 1e6}
"""Areas."""
IN_ML = {"mL": 1.0, "ml": 1.0, "cm3": 1.0, "mm3": 1e-3, "uL": 1e-3, "µL": 1e-3, "L": 1e3, "m3": 1e6}
"""Volumes."""
IN_S = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
"""Times."""
UNITS = {*IN_KPA, *IN_MN, *IN_MM, *IN_MM2, *IN_ML, *IN_S, "%", "-", "mm/mm", ""}
"""Names that a row of units may have."""


def with_unit(word: str) -> tuple[str, str]:
    """Return the name and the unit of a column such as ``stress_x [kPa]``; no unit is empty."""
    match = _WITH_UNIT.fullmatch(word.strip())
    return (match[1], match[2] or "") if match else (word, "")


def factor(word: str, unit: str, usual: str, known: Mapping[str, float]) -> float:
    """Return the factor from the unit of column ``word``, ``usual`` where it has none.

    :class:`InputError` for a unit that is not ``known``.
    """
    plain = unit.replace("²", "2").replace("³", "3").replace("^", "").replace(" ", "") or usual
    alike = [name for name in known if name.lower() == plain.lower()]
    if plain not in known and len(alike) == 1 and not plain.startswith("m"):
        (plain,) = alike
    if plain not in known:
        raise InputError(f"column '{word}': unit '{unit}' is unknown; one of {', '.join(known)}")
    return known[plain]


_MISTAKEN = (
    (IN_KPA, ("kPa", "MPa", "Pa", "mmHg")),
    (IN_MN, ("mN", "N", "gf", "kN")),
    (IN_MM, ("mm", "m", "cm", "µm")),
    (IN_MM2, ("mm2", "m2", "cm2")),
    (IN_ML, ("mL", "mm3", "L", "m3")),
    ({"1": 1.0, "%": 0.01}, ("1", "%")),
)
"""Units that are taken for one another."""

PIXELS = "pixels instead of mm? multiply by the size of a pixel in mm"
_PIXEL = 5e-4, 0.5  # mm, sizes of pixels in images of tissue
_NEAR = 3.0  # factor within which lengths too large by about 1000 are in µm


def in_pixels(unit: str, ratio: float, of_unit: float | None) -> bool:
    """Return whether numbers in ``unit`` that are to be multiplied by ``ratio`` may be in pixels.

    of_unit : the factor of the unit that is nearest, which numbers in that unit need exactly.
    """
    near = of_unit is not None and 1.0 / _NEAR < of_unit / ratio < _NEAR
    return unit == "mm" and _PIXEL[0] < ratio < _PIXEL[1] and not near


def other_units(unit: str) -> dict[str, float]:
    """Return the units that data in ``unit`` may be in by mistake, each with the factor to it."""
    return {
        name: known[name] / known[unit]
        for known, names in _MISTAKEN
        if unit in names
        for name in names
        if name != unit
    }
