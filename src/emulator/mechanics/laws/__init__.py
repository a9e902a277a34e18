"""Hyperelastic laws, one a file. To add one: write its energy, add it to ``LAWS``."""

from emulator.errors import InputError
from emulator.mechanics.laws.law import Law
from emulator.mechanics.laws.neo_hookean import NEO_HOOKEAN, NEO_HOOKEAN_E_NU

LAWS: dict[str, Law] = {law.name: law for law in (NEO_HOOKEAN, NEO_HOOKEAN_E_NU)}


def find_law(name: str) -> Law:
    """The registered law called ``name``; :class:`InputError` names the known ones."""
    if name not in LAWS:
        raise InputError(f"law '{name}' is unknown; known laws: {', '.join(sorted(LAWS))}")
    return LAWS[name]


__all__ = ["LAWS", "Law", "find_law"]
