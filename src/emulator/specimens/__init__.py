"""Specimens: mechanical tests and tubes in homogeneous states, and the piece between its grips.

A room: the core reaches it by the registries of forward maps and observations, and by scene files.
"""
