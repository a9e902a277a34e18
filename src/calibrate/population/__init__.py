"""Several bodies drawn from one population: members, what they share, and those not yet seen."""

from calibrate.population.model import HierarchicalModel, hierarchical_model
from calibrate.population.posterior import Hierarchy, read_hierarchy
from calibrate.population.sample import hierarchy, sample_hierarchy

__all__ = [
    "HierarchicalModel",
    "Hierarchy",
    "hierarchical_model",
    "hierarchy",
    "read_hierarchy",
    "sample_hierarchy",
]
