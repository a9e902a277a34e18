"""Populations: several bodies, the members, that share the distribution of some unknowns.

:func:`hierarchy` calibrates a population and its members together, as a hierarchical model.
"""

from calibrate.population.model import PopulationModel as PopulationModel
from calibrate.population.model import population_model as population_model
from calibrate.population.posterior import Hierarchy, read_hierarchy
from calibrate.population.sample import hierarchy
from calibrate.population.sample import sample_population as sample_population

__all__ = ["Hierarchy", "hierarchy", "read_hierarchy"]
