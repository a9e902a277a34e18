"""Meshes, and their geometry without a material: sets, facets, volumes, fibres, bodies."""

from emulator.geometry import generators

__all__ = ["generators"]
