"""Importance weights of points: their effective number, and the tail of their distribution."""

from __future__ import annotations

import numpy as np

from calibrate.arviz import array_stats

LARGEST_PARETO_SHAPE = 0.7  # Vehtari et al. (2024): beyond, means of weighted points are not known
FEWEST_WEIGHTS = 25  # weights whose largest fifth has a tail to fit
_EQUAL = 1e-3  # log weights closer together than this have no tail to fit


def normalised(log_weights: np.ndarray) -> np.ndarray:
    """Return weights of sum 1; zeros where no log weight is finite."""
    largest = np.max(log_weights)
    if not np.isfinite(largest):
        return np.zeros_like(log_weights)
    weights = np.exp(log_weights - largest)
    return weights / weights.sum()


def effective(weights: np.ndarray) -> float:
    """Return the effective number of weighted points (Kish), 0 where all weights are 0."""
    square = float(np.sum(weights**2))
    return 1.0 / square if square > 0.0 else 0.0


def smoothed(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Return log weights (s,) of sum 1 with a smoothed tail, and the tail's Pareto shape.

    The shape (Vehtari et al. 2024) is 0 where weights are equal to 0.1 %, NaN where there are too
    few to have a tail, and infinite where the tail repeats one draw. Such weights stay as they are.
    """
    log_weights = log_weights - log_weights.max()
    plain = log_weights - np.log(np.exp(log_weights).sum())
    if len(log_weights) < FEWEST_WEIGHTS:
        return plain, float("nan")
    if np.ptp(log_weights) < _EQUAL:
        return plain, 0.0
    try:
        # ArviZ takes log likelihoods and negates them (docs/experiments.md, "A sign").
        result, shape = array_stats.psislw(-log_weights)
    except ValueError:
        return plain, float("inf")
    return result, float(shape)


def pareto_shape(log_weights: np.ndarray) -> float:
    """Return the Pareto shape of the tail of weights, see :func:`smoothed`."""
    return smoothed(log_weights)[1]
