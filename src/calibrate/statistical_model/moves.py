r"""Moves of posterior means by FEM in place of the forward map, estimated from a few FEM solves.

A map that is right where its posterior has draws may be wrong where it has none, and its posterior
then lacks a part. So FEM is asked at draws, around them, a Gauss-Newton step up its own posterior
from there, with the map's slopes, and at points of the pool of
:mod:`calibrate.statistical_model.pool` under a correction of the map that the answers so far teach.
The pool, weighted by the likelihood with the last correction and by the map's, has the two
posteriors' means.

A correction is smooth, and where the map fails abruptly it is wrong, too. So points count at which
FEM finds the data likely, and neither the map did nor the correction before it was told: the
posterior then lacks a part of unknown mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from calibrate.importance.proposals import Kernels
from calibrate.importance.weights import normalised
from calibrate.statistical_model.density import finite_coordinates
from calibrate.statistical_model.pool import Pool
from calibrate.statistical_model.predictive import Predictive, gauss_newton_step
from emulator.surrogates.correction import Correction, fit_correction

_ROUNDS = 3  # of points that are no draws
_SURPRISE = (
    2.0  # nats by which FEM's likelihood exceeds what was predicted, where a part is missing
)
_LIKELY = 2.0  # nats below the best point, beside half a nat an unknown, that count as likely
_VARIES = 1e-9  # sd of draws, relative to the largest, below which they do not vary
_FITTED_TO = 15.0  # the same, of points at which a correction has to be good


class FEMAnswer(NamedTuple):
    """FEM at a point z (p,): its data less the map's, flat (m,), and its log likelihood."""

    z: np.ndarray
    error: np.ndarray
    log_likelihood: float


def largest_move(
    predictive: Predictive,
    z: np.ndarray,
    answers: Sequence[FEMAnswer],
    ask: Callable[[np.ndarray], list[FEMAnswer]],
    count: int,
    rng: np.random.Generator,
) -> float:
    """Return the largest move of a mean in posterior sd; infinite where the posterior lacks a part.

    Parameters
    ----------
    z : draws (s, p) of the map's posterior. answers : FEM at four of them or more.
    ask : the function that returns FEM's answers at points (k, p), as many as there are.
    count : the number of points of a round.
    """
    rows, answers, surprises = len(answers) + _ROUNDS * count, list(answers), list[float]()
    correction = _fitted(predictive, answers, rows)
    known, fresh = len(answers), list[FEMAnswer]()
    for round_ in ("around", "uphill", "pool"):
        if round_ == "around":
            points = Kernels.surrounding(z, rng).sample(rng, count)
        elif round_ == "uphill":
            points = np.array([_uphill(predictive, answer) for answer in fresh])
        else:
            pool = Pool.search(predictive, correction, z, (), rng)
            chances = 0.5 * (normalised(pool.log_explored) + pool.corrected)
            points = pool.z[rng.choice(len(pool.z), size=count, p=chances)]
        if fresh := ask(points):
            asked = np.array([answer.z for answer in fresh])
            at = predictive.evaluate(asked, correction)
            predicted = np.maximum(at.corrected, at.cheap)
            surprises += [a.log_likelihood - p for a, p in zip(fresh, predicted, strict=True)]
        answers += fresh
        correction = _fitted(predictive, answers, rows)
    pool = Pool.search(predictive, correction, z, (), rng)
    heights = _heights(predictive, answers)
    likely = heights > np.max(heights) - _LIKELY - 0.5 * z.shape[1]
    if np.any(likely[known:] & (np.array(surprises) > _SURPRISE)):
        return np.inf
    moves = (pool.corrected - normalised(pool.log_cheap)) @ predictive.columns(pool.z)
    draws = predictive.columns(z)
    vary = draws.std(axis=0) > _VARIES * np.abs(draws).max(axis=0)
    return float(np.max(np.abs(moves[vary]) / draws.std(axis=0)[vary], initial=0.0))


def _uphill(predictive: Predictive, answer: FEMAnswer) -> np.ndarray:
    """Return the point (p,) a Gauss-Newton step up FEM's log posterior from an answer's point."""
    means = predictive.means(answer.z[None])[0][0] + answer.error
    _, gradient, curvature = predictive.curvature(answer.z, means, predictive.slopes(answer.z))
    step, _ = gauss_newton_step(gradient, curvature, predictive.prior_sd)
    return finite_coordinates(answer.z + step)


def _heights(predictive: Predictive, answers: list[FEMAnswer]) -> np.ndarray:
    """Return FEM's log posterior density (k,) at the answers' points, up to a constant."""
    prior = predictive.by_map(np.array([answer.z for answer in answers]))[0]
    return np.asarray(prior) + [answer.log_likelihood for answer in answers]


def _fitted(predictive: Predictive, answers: list[FEMAnswer], rows: int) -> Correction:
    """Fit a correction to FEM's answers, with arrays of the shapes for ``rows`` points."""
    features = predictive.features(np.array([answer.z for answer in answers]))
    errors = np.array([answer.error for answer in answers])
    heights = _heights(predictive, answers)
    likely = heights > np.max(heights) - _FITTED_TO - 0.5 * features.shape[1]
    return fit_correction(features, errors, predictive.scales, rows, likely)
