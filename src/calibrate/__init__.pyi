from .analysis.identifiability import identify, in_words, stress_band
from .analysis.sbc import LEVELS, sbc
from .analysis.sensitivity import sensitivity
from .arviz import array_stats
from .certificate import Certificate, certify, reweight
from .figures.sensitivity import body_figure, index_figure
from .measurements import (
    OBSERVATIONS,
    CavityVolume,
    Klotz,
    KlotzVolume,
    MeasuredParameter,
    Reaction,
    Scalar,
    landmarks,
    length_between,
    nodal_displacements,
    parse_observation,
    rigid_markers,
    segment_strains,
    spread_landmarks,
    strains,
    surface_distances,
    surface_points,
)
from .measurements.full_field import FullField, field_data, read_full_field
from .measurements.stress import stresses
from .measurements.stretch import stretches
from .measurements.tube import TubeForce, TubePressure
from .model_error import placement, rigid_motion
from .noise import CorrelatedNoise, GaussianNoise, StudentTNoise
from .population import Hierarchy, hierarchy, read_hierarchy
from .posterior import Posterior, sample
from .posterior.comparison import compare
from .posterior.predictions import klotz_band
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
from .project import by_fem, infer, load, read_posterior
from .project.campaigns import campaign
from .project.experiment import read_experiment
from .report import write_report
from .samplers import (
    SAMPLERS,
    AutoOptions,
    BlackJAXNUTSOptions,
    ChainOptions,
    ChainSampler,
    Density,
    ImportanceOptions,
    Kernel,
    LaplaceOptions,
    NUTSOptions,
    SMCOptions,
    density_of,
)
from .statistical_model import Model
from .statistical_model.errors import with_described_errors, with_systematic
from .statistical_model.model import model
from .um_bridge import serve

def mend_numpyro() -> None: ...

__version__: str

__all__ = [
    "LEVELS",
    "OBSERVATIONS",
    "SAMPLERS",
    "AutoOptions",
    "BlackJAXNUTSOptions",
    "CavityVolume",
    "Certificate",
    "ChainOptions",
    "ChainSampler",
    "CorrelatedNoise",
    "Density",
    "Dependence",
    "FullField",
    "GaussianNoise",
    "Hierarchy",
    "ImportanceOptions",
    "JointPrior",
    "Kernel",
    "Klotz",
    "KlotzVolume",
    "LaplaceOptions",
    "MeasuredParameter",
    "Model",
    "NUTSOptions",
    "Population",
    "Posterior",
    "Reaction",
    "SMCOptions",
    "Scalar",
    "StudentTNoise",
    "TubeForce",
    "TubePressure",
    "array_stats",
    "body_figure",
    "box_prior",
    "by_fem",
    "campaign",
    "certify",
    "compare",
    "density_of",
    "field_data",
    "hierarchy",
    "identify",
    "in_words",
    "index_figure",
    "infer",
    "klotz_band",
    "landmarks",
    "length_between",
    "load",
    "log_normal",
    "model",
    "nodal_displacements",
    "parse_observation",
    "placement",
    "population_of_fits",
    "read_experiment",
    "read_full_field",
    "read_hierarchy",
    "read_posterior",
    "reweight",
    "rigid_markers",
    "rigid_motion",
    "sample",
    "sbc",
    "segment_strains",
    "sensitivity",
    "serve",
    "spread_landmarks",
    "strains",
    "stress_band",
    "stresses",
    "stretches",
    "surface_distances",
    "surface_points",
    "truncated",
    "truncated_normal",
    "with_described_errors",
    "with_systematic",
    "write_report",
]
