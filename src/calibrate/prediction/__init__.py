"""Predictions of another body, load or test by the draws of a posterior."""

from calibrate.prediction.predict import Predicted, predict_on

__all__ = ["Predicted", "predict_on"]
