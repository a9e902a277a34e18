"""Neighbours: posteriors for other finite element programs."""

from calibrate.neighbours.export import Export, export_posterior

__all__ = ["Export", "export_posterior"]
