"""Priors: of one parameter, of several that correlate, and of a population of ventricles."""

from calibrate.priors.population import Population, population_of_fits, prior_of
from calibrate.priors.priors import (
    Dependence,
    JointPrior,
    Prior,
    bisect,
    bounds,
    box_prior,
    dependence_of,
    log_normal,
    truncated,
    truncated_normal,
)

__all__ = [
    "Dependence",
    "JointPrior",
    "Population",
    "Prior",
    "bisect",
    "bounds",
    "box_prior",
    "dependence_of",
    "log_normal",
    "population_of_fits",
    "prior_of",
    "truncated",
    "truncated_normal",
]
