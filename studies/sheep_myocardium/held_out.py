r"""Predictions of a mode from the other eight.

The draws of all nine modes are weighted by :math:`1 / p(y_m \mid \theta)`, smoothed (PSIS; Vehtari,
Gelman and Gabry 2017); where the tail of the weights is too heavy, the posterior is sampled again
without the mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from scipy.special import logsumexp
from studies.common.output import Case
from studies.sheep_myocardium.experiment import MODES
from studies.sheep_myocardium.inference import Found, covariances, sample

_HEAVIEST = 0.7  # Pareto shape of the weights' tail
_LEVELS = (0.05, 0.5, 0.95)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Of one mode from the others.

    bands : (3, j) 5, 50 and 95 % of its forces in N. log_density : of its data. inside : points of
    the data in the bands. again : whether the posterior was sampled again. heavy : whether the
    weights' tail is too heavy and it was not.
    """

    bands: np.ndarray
    log_density: float
    inside: int
    again: bool
    heavy: bool


def held_out(found: Found, seed: int, *, refit: bool = True) -> dict[str, Prediction]:
    """Each mode predicted from the others."""
    told = {}
    for k, mode in enumerate(MODES):
        densities = found.log_likelihoods[:, k]
        log_weights, shape = array_stats.psislw(-(densities - densities.max()))
        heavy, used = bool(shape > _HEAVIEST), found
        if heavy and refit:
            how = {"left_out": (mode,), "known": found.modes, "chains": 1}
            used = sample(found.heart, found.of.cubes, seed + k, found.law, **how)
            densities, log_weights = used.log_likelihoods[:, k], np.zeros(len(used.positions))
        log_weights = log_weights - logsumexp(log_weights)
        bands = predicted(used, k, np.exp(log_weights), np.random.default_rng(seed + k))
        force = np.asarray(found.of.data[k])
        inside = int(((bands[0] <= force) & (force <= bands[2])).sum())
        density = float(logsumexp(log_weights + densities))
        told[mode] = Prediction(bands, density, inside, heavy and refit, heavy and not refit)
    return told


def predicted(
    found: Found, mode: int, weights: np.ndarray, rng: np.random.Generator, count: int = 2000
) -> np.ndarray:
    """Quantiles (3, j) in N of what would be measured in a mode."""
    rows = rng.choice(len(weights), count, p=weights / weights.sum())
    mean, omega = found.draws["means"][rows, mode], found.draws["omega"][rows]
    measured = replicated(np.asarray(found.of.amounts[mode]), mean, omega, rng)
    return np.quantile(measured, _LEVELS, axis=0)


def replicated(
    amounts: np.ndarray, mean: np.ndarray, omega: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """What would be measured (d, j) in N, of forces ``mean`` (d, j) off by ``omega`` (d,)."""
    covariance = covariances(*map(jnp.asarray, (amounts, mean, omega[:, None, None])))
    half = np.linalg.cholesky(np.asarray(covariance))
    return mean + (half @ rng.normal(size=mean.shape)[..., None])[..., 0]


def summed(told: dict[str, Prediction]) -> Case:
    """Points inside the bands, and the log density of all held-out modes."""
    points = sum(p.bands.shape[1] for p in told.values())
    return {
        "inside": sum(p.inside for p in told.values()),
        "points": points,
        "log_density": float(sum(p.log_density for p in told.values())),
        "log_density_by_mode": {mode: p.log_density for mode, p in told.items()},
        "inside_by_mode": {mode: p.inside for mode, p in told.items()},
        "sampled_again": sum(p.again for p in told.values()),
        "heavy_tails": sum(p.heavy for p in told.values()),
    }
