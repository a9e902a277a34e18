"""Neighbours: posteriors for other finite element programs."""

from calibrate.neighbours.export import Export, export

__all__ = ["Export", "export"]
