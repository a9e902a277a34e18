"""Hyperelastic laws, one a file.

To add one, write a file with its energy, a function of a ``Strain`` (see
:mod:`emulator.mechanics.kinematics`) and the law's parameters; wrap it in a :class:`Law` and name
it in the file's ``LAWS``. The registry reads every file of this package; stress and tangent follow
by differentiation. The tests in ``tests/emulator/mechanics/test_laws.py`` include the law once
``tests/law_support.py`` has values for it. ``docs/extending.md`` has the steps.
"""

import pkgutil
from importlib import import_module

from emulator.core.errors import look_up
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import (
    Law,
    Quantity,
    logarithmic,
    modulus,
    number,
    quadratic,
    quadratic_logarithmic,
)

LAWS: dict[str, Law] = {
    law.name: law
    for file in sorted(module.name for module in pkgutil.iter_modules(__path__))
    for law in getattr(import_module(f"{__name__}.{file}"), "LAWS", ())
}


def find_law(name: str) -> Law:
    """Return the registered law called ``name``; :class:`InputError` names the known ones."""
    return look_up(LAWS, name, "law")


__all__ = [
    "LAWS",
    "Law",
    "Quantity",
    "Strain",
    "find_law",
    "logarithmic",
    "modulus",
    "number",
    "quadratic",
    "quadratic_logarithmic",
]
