"""Hyperelastic laws, one a file.

To add one, write a file with its energy, a function of a ``Strain`` (see
:mod:`emulator.mechanics.kinematics`) and the law's parameters; wrap it in a :class:`Law` and add
that to ``LAWS``. Stress and tangent follow. The tests in ``tests/emulator/mechanics/test_laws.py``
take it up from the registry once their ``ARGUMENTS`` have values for it. ``docs/adding_a_law.md``
does it step by step.
"""

from emulator.errors import InputError
from emulator.mechanics.laws.guccione import GUCCIONE
from emulator.mechanics.laws.holzapfel_ogden import HOLZAPFEL_OGDEN, HOLZAPFEL_OGDEN_RELEASED
from emulator.mechanics.laws.holzapfel_ogden_orthotropic import HOLZAPFEL_OGDEN_ORTHOTROPIC
from emulator.mechanics.laws.law import Law
from emulator.mechanics.laws.neo_hookean import (
    NEO_HOOKEAN,
    NEO_HOOKEAN_E_NU,
    NEO_HOOKEAN_SPLIT,
)

LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        NEO_HOOKEAN,
        NEO_HOOKEAN_E_NU,
        NEO_HOOKEAN_SPLIT,
        HOLZAPFEL_OGDEN,
        HOLZAPFEL_OGDEN_RELEASED,
        HOLZAPFEL_OGDEN_ORTHOTROPIC,
        GUCCIONE,
    )
}


def find_law(name: str) -> Law:
    """The registered law called ``name``; :class:`InputError` names the known ones."""
    if name not in LAWS:
        raise InputError(f"law '{name}' is unknown; known laws: {', '.join(sorted(LAWS))}")
    return LAWS[name]


__all__ = ["LAWS", "Law", "find_law"]
