"""Predictions of another body, load or test by the draws of a posterior."""

from calibrate.prediction.predict import Predicted, predict_on
from calibrate.prediction.several import Weights, mixture, weights_of
from calibrate.prediction.transfer import Learned, made_of

__all__ = ["Learned", "Predicted", "Weights", "made_of", "mixture", "predict_on", "weights_of"]
