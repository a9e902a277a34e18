"""Meshes and what can be said of them without a material: sets, facets, volumes, fibres, bodies."""
