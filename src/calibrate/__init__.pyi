from . import analysis, fields, model_error, population, priors, samplers
from .analysis.identifiability import identify
from .analysis.sbc import sbc
from .analysis.sensitivity import sensitivity
from .arviz import array_stats
from .certificate import Certificate, certify, reweight
from .figures.sensitivity import body_figure, calibration_figure, index_figure
from .measurements import (
    OBSERVATIONS,
    CavityVolume,
    Klotz,
    KlotzVolume,
    MeasuredParameter,
    Observations,
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
from .measurements.data import write_data
from .measurements.stress import stresses
from .measurements.stretch import stretches
from .measurements.tube import TubeForce, TubePressure
from .noise import CorrelatedNoise, GaussianNoise, StudentTNoise
from .posterior import Posterior, sample
from .posterior.comparison import compare
from .posterior.predictions import klotz_band
from .project import by_fem, infer, load, read_posterior
from .project.campaigns import campaign
from .project.experiment import read_experiment
from .report import write_report
from .statistical_model import Model
from .statistical_model.errors import with_described_errors, with_systematic
from .statistical_model.fem_likelihood import FEMLikelihood
from .statistical_model.model import model
from .um_bridge import serve

def mend_numpyro() -> None: ...

__version__: str

__all__ = [
    "OBSERVATIONS",
    "CavityVolume",
    "Certificate",
    "CorrelatedNoise",
    "FEMLikelihood",
    "GaussianNoise",
    "Klotz",
    "KlotzVolume",
    "MeasuredParameter",
    "Model",
    "Observations",
    "Posterior",
    "Reaction",
    "Scalar",
    "StudentTNoise",
    "TubeForce",
    "TubePressure",
    "analysis",
    "array_stats",
    "body_figure",
    "by_fem",
    "calibration_figure",
    "campaign",
    "certify",
    "compare",
    "fields",
    "identify",
    "index_figure",
    "infer",
    "klotz_band",
    "landmarks",
    "length_between",
    "load",
    "model",
    "model_error",
    "nodal_displacements",
    "parse_observation",
    "population",
    "priors",
    "read_experiment",
    "read_posterior",
    "reweight",
    "rigid_markers",
    "sample",
    "samplers",
    "sbc",
    "segment_strains",
    "sensitivity",
    "serve",
    "spread_landmarks",
    "strains",
    "stresses",
    "stretches",
    "surface_distances",
    "surface_points",
    "with_described_errors",
    "with_systematic",
    "write_data",
    "write_report",
]
