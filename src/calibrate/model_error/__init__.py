"""Errors that correlate many numbers of a model's data: their kinds, and their marginalisation."""

from calibrate.model_error.marginal import ModelError
from calibrate.model_error.systematic import Systematic, placement, rigid_motion

__all__ = ["ModelError", "Systematic", "placement", "rigid_motion"]
