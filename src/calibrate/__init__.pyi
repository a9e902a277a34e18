from .campaigns import campaign
from .certificate import Certificate, certify, reweight
from .comparison import compare
from .identifiability import identify
from .joint_prior import Dependence, JointPrior
from .noise import CorrelatedNoise, DiscrepancyNoise, GaussianNoise, StudentTNoise
from .observations import (
    CavityVolume,
    MeasuredParameter,
    landmarks,
    length_between,
    nodal_displacements,
    segment_strains,
    strains,
    surface_points,
)
from .population import Population, population_of_fits
from .posterior import Posterior, sample
from .priors import box_prior, log_normal, truncated, truncated_normal
from .samplers import Density, NUTSOptions, density_of
from .sensitivity_analysis import sensitivity
from .simulation_based import sbc
from .statistical_model import Model, model
from .workflow import load

__version__: str

__all__ = [
    "CavityVolume",
    "Certificate",
    "CorrelatedNoise",
    "Density",
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
    "campaign",
    "certify",
    "compare",
    "density_of",
    "identify",
    "landmarks",
    "length_between",
    "load",
    "log_normal",
    "model",
    "nodal_displacements",
    "population_of_fits",
    "reweight",
    "sample",
    "sbc",
    "segment_strains",
    "sensitivity",
    "strains",
    "surface_points",
    "truncated",
    "truncated_normal",
]
