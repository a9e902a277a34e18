r"""Predictions of a mode from the other eight.

The draws of all nine modes are weighted by :math:`1 / p(y_m \mid \theta)`, smoothed (PSIS; Vehtari,
Gelman and Gabry 2017); where the tail of the weights is too heavy, the posterior is sampled again
without the mode. Without it draws may go where no run of FEM has been: where forces are not known
there (:mod:`.doubts`), the weights stay.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.special import logsumexp
from studies.common.output import Case, cores
from studies.sheep_myocardium.curves import Fit
from studies.sheep_myocardium.doubts import UNKNOWN, doubts, known_to
from studies.sheep_myocardium.experiment import MODES
from studies.sheep_myocardium.inference import Found, covariances, sample

import calibrate as cal

_HEAVIEST = 0.7  # Pareto shape of the weights' tail
_LEVELS = (0.05, 0.5, 0.95)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Of one mode from the others.

    bands : (3, j) 5, 50 and 95 % of its forces in N. log_density : of its data. inside : points of
    the data in the bands. again : whether draws of the posterior without the mode made it. heavy :
    whether weights did whose tail is too heavy.
    """

    bands: np.ndarray
    log_density: float
    inside: int
    again: bool
    heavy: bool


def held_out(found: Found, seed: int, fitted: Fit | None = None) -> dict[str, Prediction]:
    """Each mode predicted from the others.

    Sampled again only where what its cubes were ``fitted`` to is given.
    """

    def apart(k: int) -> Prediction:
        densities = found.log_likelihoods[:, k]
        log_weights, shape = cal.array_stats.psislw(densities)  # negates them
        heavy = not shape < _HEAVIEST
        used = _without(MODES[k], found, fitted, seed + k) if heavy and fitted is not None else None
        if used is not None:
            densities = used.log_likelihoods[:, k]
            log_weights = np.full(len(densities), -np.log(len(densities)))
        rng = np.random.default_rng(seed + k)
        bands = predicted(used or found, k, np.exp(log_weights), rng)
        force = np.asarray(found.of.data[k])
        inside = int(((bands[0] <= force) & (force <= bands[2])).sum())
        density = float(logsumexp(log_weights + densities))
        return Prediction(bands, density, inside, used is not None, heavy and used is None)

    with ThreadPoolExecutor(cores()) as pool:
        return dict(zip(MODES, pool.map(apart, range(len(MODES))), strict=True))


def _without(mode: str, found: Found, fitted: Fit, seed: int) -> Found | None:
    """The posterior without a mode's data, or None where its forces are not known."""
    how = {"left_out": (mode,), "angles": bool(found.of.turned), "known": found.modes}
    how |= {"chains": 1, "times": 2}
    anew = sample(found.heart, found.of.cubes, seed, found.law, **how)
    doubt = known_to(doubts(fitted, anew)).max()
    if doubt <= UNKNOWN:
        return anew
    print(f"{found.heart.name} without {mode}: log likelihood known to {doubt:.2f}", flush=True)
    return None


def predicted(
    found: Found, mode: int, weights: np.ndarray, rng: np.random.Generator, count: int = 2000
) -> np.ndarray:
    """Quantiles (3, j) in N of what would be measured in a mode."""
    rows = rng.choice(len(weights), count, p=weights / weights.sum())
    mean, omega = found.draws["means"][rows, mode], found.draws["omega"][rows]
    amounts = np.asarray(found.of.amounts[mode])
    measured = replicated(amounts, mean, omega, rng.normal(size=mean.shape))
    return np.quantile(measured, _LEVELS, axis=0)


def replicated(
    amounts: np.ndarray, mean: np.ndarray, omega: np.ndarray, z: np.ndarray
) -> np.ndarray:
    """What would be measured (d, j) in N, of forces ``mean`` (d, j) off by ``omega`` (d,).

    z : standard normals (d, j).
    """
    covariance = covariances(*map(jnp.asarray, (amounts, mean, omega[:, None, None])))
    half = np.linalg.cholesky(np.asarray(covariance))
    return mean + (half @ z[..., None])[..., 0]


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
