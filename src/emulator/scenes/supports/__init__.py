"""Supports, one kind a file; ``SUPPORTS`` is their registry."""

from emulator.scenes.part import BoundaryCondition
from emulator.scenes.supports.dirichlet import Support
from emulator.scenes.supports.elastic import Dashpots, ElasticSupport

SUPPORTS: dict[str, type[BoundaryCondition]] = {
    support.kind: support for support in (Support, ElasticSupport, Dashpots)
}

__all__ = ["SUPPORTS", "BoundaryCondition", "Dashpots", "ElasticSupport", "Support"]
