"""The statistical model around a forward map."""

from calibrate.statistical_model.fem_likelihood import FEMLikelihood
from calibrate.statistical_model.model import Data, Model, at_sites

__all__ = ["Data", "FEMLikelihood", "Model", "at_sites"]
