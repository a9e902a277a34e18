"""Priors of laws from published parameters of tissues, which ``calibrate init`` writes.

A median is that of a law's published parameters. The log-sd is that between subjects where five or
more were published with their spread. Elsewhere it is 1, and 0.7 of exponents, which vary less
between hearts than moduli do. Around the values of human hearts in vivo, the fits of Holzapfel &
Ogden (2009), Table 1, to dogs and pigs are then within 2.2 log-sds (a 0.057 to 2.28 kPa, b 8.0 to
9.7, a_f 1.7 to 21.5 kPa), but for b_f, 15.8 to 16.0 (2.9).
"""

from __future__ import annotations

from collections.abc import Mapping

from emulator.scenes.parameter_space import LogNormal

_HUMAN = (
    "human left ventricles in vivo, middle of the range of Dalton, Husmeier & Gao (2023), "
    "Section 3.4; no published spread: log-sd 1, of exponents 0.7"
)
_PIG = (
    "left ventricle of a pig in simple shear, Holzapfel & Ogden (2009), Table 1; no published "
    "spread: log-sd 1, of exponents 0.7"
)
_FAILING = (
    "7 human left ventricles in heart failure, {} (doi 10.1007/s10237-016-0865-3); a healthy one "
    "has {}"
)
_FILLED = (
    "24 normal human left ventricles at end-diastole, 0.67 to 1.60 kPa, the range as one log-sd to "
    "each side; 26 diseased ones have 1.73 to 5.07"
)


def _alike(source: str, **medians: float) -> dict[str, LogNormal]:
    return {
        name: LogNormal(median, 0.7 if name.startswith("b") else 1.0, source)
        for name, median in medians.items()
    }


_MATRIX = _alike(_HUMAN, a=0.322, b=2.05)
_MYOCARDIUM = _MATRIX | _alike(_HUMAN, a_f=5.57, b_f=2.11)
# a and a_f are half the textbook's.
_RELEASED = _MYOCARDIUM | _alike(_HUMAN, a=0.161, a_f=2.79)
_ORTHOTROPIC = _alike(
    _PIG, a=0.059, b=8.02, a_f=18.5, b_f=16.0, a_s=2.48, b_s=11.1, a_fs=0.216, b_fs=11.4
)
# Of mean m and sd s: the median m / sqrt(1 + s^2/m^2), and the log-sd sqrt(ln(1 + s^2/m^2)).
_GUCCIONE = {
    "C": LogNormal(2.61, 0.53, _FAILING.format("mean 3.0, sd 1.7 kPa", "1.7 kPa")),
    "b_f": LogNormal(21.8, 0.52, _FAILING.format("mean 25, sd 14", 8)),
    "b_t": LogNormal(7.87, 0.52, _FAILING.format("mean 9, sd 5", 3)),
    "b_fs": LogNormal(9.66, 0.52, _FAILING.format("mean 11, sd 6", 4)),
}
OF_LAWS: Mapping[str, Mapping[str, LogNormal]] = {
    "holzapfel_ogden": _MYOCARDIUM,
    "holzapfel_ogden_unswitched": _MYOCARDIUM,
    "holzapfel_ogden_dispersed": _MYOCARDIUM,
    "holzapfel_ogden_dispersed_unswitched": _MYOCARDIUM,
    "holzapfel_ogden_isotropic": _MATRIX,
    "holzapfel_ogden_released": _RELEASED,
    "holzapfel_ogden_orthotropic": _ORTHOTROPIC,
    "guccione": _GUCCIONE,
}
"""The priors of each law's parameters, by the law's name."""

PRESSURE = LogNormal(1.07, 0.44, _FILLED)
"""The prior of the pressure that fills a left ventricle, kPa."""
