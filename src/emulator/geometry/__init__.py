"""Meshes, and their geometry without a material: sets, facets, volumes, fibres, bodies."""
