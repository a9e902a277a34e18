from .calibration import certify_and_keep, infer, report
from .problem import (
    Problem,
    by_fem,
    model_before_data,
    read_problem,
    simulator_of,
)
from .results import holds_population, load, read_posterior
from .rounds import by_rounds
from .run import Run

__all__ = [
    "Problem",
    "Run",
    "by_fem",
    "by_rounds",
    "certify_and_keep",
    "holds_population",
    "infer",
    "load",
    "model_before_data",
    "read_posterior",
    "read_problem",
    "report",
    "simulator_of",
]
