"""Supports, one kind a file; ``SUPPORTS`` is their registry."""

from emulator.scenes.part import BoundaryCondition
from emulator.scenes.supports.dirichlet import Support
from emulator.scenes.supports.elastic import ElasticSupport

SUPPORTS: dict[str, type[BoundaryCondition]] = {
    support.kind: support for support in (Support, ElasticSupport)
}

__all__ = ["SUPPORTS", "BoundaryCondition", "ElasticSupport", "Support"]
