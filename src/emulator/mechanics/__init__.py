"""Mechanics of one material point: strain measures, laws, units. No mesh here."""

from emulator.mechanics import laws

__all__ = ["laws"]
