"""Priors: of one parameter, of several that correlate, and of a population of ventricles."""

from calibrate.priors.population import Population, population_of_fits
from calibrate.priors.population import prior_of as prior_of
from calibrate.priors.priors import (
    Dependence,
    JointPrior,
    box_prior,
    log_normal,
    truncated,
    truncated_normal,
)
from calibrate.priors.priors import Prior as Prior
from calibrate.priors.priors import bisect as bisect
from calibrate.priors.priors import bounds as bounds
from calibrate.priors.priors import dependence_of as dependence_of

__all__ = [
    "Dependence",
    "JointPrior",
    "Population",
    "box_prior",
    "log_normal",
    "population_of_fits",
    "truncated",
    "truncated_normal",
]
