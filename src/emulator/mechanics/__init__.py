"""Mechanics of one material point: strain measures, laws, units. No mesh here."""
