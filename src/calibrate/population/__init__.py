"""Populations: several bodies, the members, that share the distribution of some unknowns.

:func:`hierarchy` calibrates a population and its members together, as a hierarchical model.
"""

from calibrate.population.model import PopulationModel, population_model
from calibrate.population.posterior import Hierarchy, read_hierarchy
from calibrate.population.sample import hierarchy, sample_population

__all__ = [
    "Hierarchy",
    "PopulationModel",
    "hierarchy",
    "population_model",
    "read_hierarchy",
    "sample_population",
]
