"""Predictions of another body, load or test by the draws of a posterior."""

from calibrate.prediction.predict import Predicted, predict_on
from calibrate.prediction.transfer import Learned

__all__ = ["Learned", "Predicted", "predict_on"]
