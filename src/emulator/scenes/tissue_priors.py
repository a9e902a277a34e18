"""Priors of laws from published parameters of tissues, which ``calibrate init`` writes.

A median is that of a law's published parameters. The log-sd is that between subjects where five or
more were published with their spread. Elsewhere it is 1, and 0.7 of exponents, which vary less
between hearts than moduli do. Around the values of human hearts in vivo, the fits of Holzapfel &
Ogden (2009), Table 1, to dogs and pigs are then within 2.2 log-sds (a 0.057 to 2.28 kPa, b 8.0 to
9.7, a_f 1.7 to 21.5 kPa), but for b_f, 15.8 to 16.0 (2.9).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from emulator.core.errors import InputError, look_up
from emulator.mechanics.laws import LAWS, Law
from emulator.scenes.parameter_space import LogNormal

LOG_SD, LOG_SD_OF_NUMBERS = 1.0, 0.7
"""Log-sds of priors for which no spread is published: of moduli, and of exponents."""
_HUMAN = (
    "human left ventricles in vivo, middle of the range of Dalton, Husmeier & Gao (2023), "
    "Section 3.4; no published spread: log-sd 1, of exponents 0.7"
)
_PIG = (
    "left ventricle of a pig in simple shear, Holzapfel & Ogden (2009), Table 1; no published "
    "spread: log-sd 1, of exponents 0.7"
)
_FILLED = (
    "24 normal human left ventricles at end-diastole, 0.67 to 1.60 kPa, the range as one log-sd to "
    "each side; 26 diseased ones have 1.73 to 5.07"
)


def _alike(source: str, **medians: float) -> dict[str, LogNormal]:
    return {
        name: LogNormal(median, LOG_SD_OF_NUMBERS if name.startswith("b") else LOG_SD, source)
        for name, median in medians.items()
    }


def _failing(mean: float, sd: float, healthy: float, unit: str = "") -> LogNormal:
    r"""Return the log-normal of this mean and sd between failing hearts, to three digits.

    .. math:: \text{median} = m / \sqrt{1 + s^2 / m^2}, \qquad
        \text{log-sd}^2 = \ln(1 + s^2 / m^2)
    """
    spread = 1.0 + (sd / mean) ** 2
    source = (
        f"7 human left ventricles in heart failure, mean {mean:g}, sd {sd:g}{unit} "
        f"(doi 10.1007/s10237-016-0865-3); a healthy one has {healthy:g}{unit}"
    )
    median, log_sd = f"{mean / math.sqrt(spread):.3g}", f"{math.sqrt(math.log(spread)):.2g}"
    return LogNormal(float(median), float(log_sd), source)


_MATRIX = _alike(_HUMAN, a=0.322, b=2.05)
_MYOCARDIUM = _MATRIX | _alike(_HUMAN, a_f=5.57, b_f=2.11)
# a and a_f are half the textbook's.
_RELEASED = _MYOCARDIUM | _alike(_HUMAN, a=0.161, a_f=2.79)
_ORTHOTROPIC = _alike(
    _PIG, a=0.059, b=8.02, a_f=18.5, b_f=16.0, a_s=2.48, b_s=11.1, a_fs=0.216, b_fs=11.4
)
_GUCCIONE = {
    "C": _failing(3.0, 1.7, 1.7, " kPa"),
    "b_f": _failing(25.0, 14.0, 8.0),
    "b_t": _failing(9.0, 5.0, 3.0),
    "b_fs": _failing(11.0, 6.0, 4.0),
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

MYOCARDIUM = "myocardium"
"""The tissue whose laws' published parameters :data:`OF_LAWS` has."""
LAWS_OF_TISSUES: Mapping[str, tuple[str, ...]] = {
    "artery": ("holzapfel_gasser_ogden", "gasser_ogden_holzapfel", "fung_orthotropic"),
    "brain": ("ogden_1", "mooney_rivlin", "neo_hookean"),
    MYOCARDIUM: ("holzapfel_ogden_orthotropic", "holzapfel_ogden", "guccione"),
    "rubber": ("mooney_rivlin", "yeoh", "ogden_1"),
    "skin": ("gasser_ogden_holzapfel", "holzapfel_gasser_ogden", "fung_planar"),
}
"""The laws that the literature takes for a tissue.

Holzapfel, Gasser & Ogden (2000), Gasser, Ogden & Holzapfel (2006), Chuong & Fung (1983); Budday et
al. (2017); Holzapfel & Ogden (2009), Guccione, McCulloch & Waldman (1991); Mooney (1940), Yeoh
(1993), Ogden (1972); Tong & Fung (1976). Ogden's law has one term: of two, one test does not tell
which is which.
"""


SCATTER_OF_TISSUES: Mapping[str, float] = {
    "artery": 0.6,
    "clot": 0.23,
    "muscle": 0.45,
    MYOCARDIUM: 0.55,
    "rubber": 0.05,
    "skin": 0.5,
}
"""The log-sd of stiffness between specimens or subjects of a tissue.

Carotids in vivo, tangent modulus, 16 subjects (0.43 to 1.0); clots of 18 specimens, shear modulus
(Kakaletsis et al. 2022); muscle in vivo, 12 to 133 subjects (0.27 to 0.62); left ventricles in
vivo, global stiffness of 9 failing hearts (0.58) and Guccione's C of 7 (0.53); repeated casts of
silicone; skin of 56 backs, linear modulus and initial slope (0.40 and 0.66).
"""


def scatter_of(word: str) -> float:
    """Return the log-sd of stiffness between specimens that ``word``, a tissue or a number, names.

    :class:`InputError` for a word that is neither.
    """
    if word in SCATTER_OF_TISSUES:
        return SCATTER_OF_TISSUES[word]
    try:
        return float(word)
    except ValueError:
        known = ", ".join(SCATTER_OF_TISSUES)
        raise InputError(f"scatter of '{word}': give a tissue ({known}) or a log-sd") from None


def laws_named(words: Sequence[str]) -> tuple[str, ...]:
    """Return the names of laws, each once, where ``words`` are names of laws or of tissues.

    :class:`InputError` for a name that is neither.
    """
    for word in words:
        look_up({**LAWS, **LAWS_OF_TISSUES}, word, "law or tissue")
    names = (name for word in words for name in LAWS_OF_TISSUES.get(word, (word,)))
    return tuple(dict.fromkeys(names))


def published_exponents(law: Law, tissue: str | None) -> dict[str, LogNormal]:
    """Return the published priors of a law's parameters without a unit, for a tissue or none."""
    published = OF_LAWS.get(law.name, {}) if tissue == MYOCARDIUM else {}
    names = {quantity.name for quantity in law.quantities if not quantity.unit}
    return {name: prior for name, prior in published.items() if name in names}


PRESSURE = LogNormal(1.07, 0.44, _FILLED)
"""The prior of the pressure that fills a left ventricle, kPa."""
