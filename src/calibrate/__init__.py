"""Bayesian calibration of soft-tissue models.

A forward map (emulator, FEM, ...) and an observation make a :func:`model`; :func:`sample` draws
its posterior; :func:`certify` checks it against FEM.
"""

# NumPyro is loaded before ArviZ, which replaces it by a lazy module: a submodule imported through
# the lazy module first leaves `numpyro.distributions.distribution` undefined.
from numpyro import distributions as _distributions  # noqa: F401

import emulator
from calibrate.certificate import Certificate, certify, reweight
from calibrate.comparison import compare
from calibrate.joint_prior import Dependence, JointPrior
from calibrate.noise import CorrelatedNoise, DiscrepancyNoise, GaussianNoise, StudentTNoise
from calibrate.observations import (
    CavityVolume,
    MeasuredParameter,
    landmarks,
    length_between,
    nodal_displacements,
    segment_strains,
    strains,
    surface_points,
)
from calibrate.population import Population, population_of_fits
from calibrate.posterior import Posterior, sample
from calibrate.priors import box_prior, log_normal, truncated, truncated_normal
from calibrate.samplers import NUTSOptions
from calibrate.statistical_model import Model, model

__version__ = emulator.__version__

__all__ = [
    "CavityVolume",
    "Certificate",
    "CorrelatedNoise",
    "Dependence",
    "DiscrepancyNoise",
    "GaussianNoise",
    "JointPrior",
    "MeasuredParameter",
    "Model",
    "NUTSOptions",
    "Population",
    "Posterior",
    "StudentTNoise",
    "box_prior",
    "certify",
    "compare",
    "landmarks",
    "length_between",
    "log_normal",
    "model",
    "nodal_displacements",
    "population_of_fits",
    "reweight",
    "sample",
    "segment_strains",
    "strains",
    "surface_points",
    "truncated",
    "truncated_normal",
]
