from .analysis.identifiability import identify
from .analysis.sbc import sbc
from .analysis.sensitivity import sensitivity
from .certificate import Certificate, certify, reweight
from .measurements import (
    CavityVolume,
    Klotz,
    KlotzVolume,
    MeasuredParameter,
    Reaction,
    landmarks,
    length_between,
    nodal_displacements,
    rigid_markers,
    segment_strains,
    strains,
    surface_points,
)
from .model_error import placement, rigid_motion
from .noise import CorrelatedNoise, DiscrepancyNoise, GaussianNoise, StudentTNoise
from .population import Hierarchy, hierarchy, read_hierarchy
from .posterior import Posterior, sample
from .posterior.comparison import compare
from .posterior.klotz_band import klotz_band
from .priors import (
    Dependence,
    JointPrior,
    Population,
    box_prior,
    log_normal,
    population_of_fits,
    truncated,
    truncated_normal,
)
from .project import load
from .project.campaigns import campaign
from .samplers import Density, NUTSOptions, density_of
from .statistical_model import Model
from .statistical_model.errors import with_systematic
from .statistical_model.model import model
from .um_bridge import serve

__version__: str

__all__ = [
    "CavityVolume",
    "Certificate",
    "CorrelatedNoise",
    "Density",
    "Dependence",
    "DiscrepancyNoise",
    "GaussianNoise",
    "Hierarchy",
    "JointPrior",
    "Klotz",
    "KlotzVolume",
    "MeasuredParameter",
    "Model",
    "NUTSOptions",
    "Population",
    "Posterior",
    "Reaction",
    "StudentTNoise",
    "box_prior",
    "campaign",
    "certify",
    "compare",
    "density_of",
    "hierarchy",
    "identify",
    "klotz_band",
    "landmarks",
    "length_between",
    "load",
    "log_normal",
    "model",
    "nodal_displacements",
    "placement",
    "population_of_fits",
    "read_hierarchy",
    "reweight",
    "rigid_markers",
    "rigid_motion",
    "sample",
    "sbc",
    "segment_strains",
    "sensitivity",
    "serve",
    "strains",
    "surface_points",
    "truncated",
    "truncated_normal",
    "with_systematic",
]
