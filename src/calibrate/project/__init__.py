"""From a scene to a report: what is run is a :class:`Run`, and kept beside its results."""

from calibrate.project.run import Run
from calibrate.project.workflow import (
    by_fem,
    certify_and_keep,
    holds_population,
    infer,
    load,
    make_data,
    model_before_data,
    observed,
    read_posterior,
    report,
    simulator_of,
)

__all__ = [
    "Run",
    "by_fem",
    "certify_and_keep",
    "holds_population",
    "infer",
    "load",
    "make_data",
    "model_before_data",
    "observed",
    "read_posterior",
    "report",
    "simulator_of",
]
