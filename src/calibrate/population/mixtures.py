r"""The likelihoods of members as mixtures of normals, from draws of each alone.

Draws of a member are weighted by :math:`N(b, B) / \pi`, with mean b and covariance B of its prior
:math:`\pi` on the parameters' scales, so that they are draws under that normal as prior; under
log-normal priors they are so already. A mixture :math:`\sum_j a_j N(\mu_j, C_j)` is fitted to
them, of as many parts as pay by the Bayesian information criterion. Each part is the prior times a
normal likelihood

.. math:: e^{c + h^T t - t^T \Lambda t / 2}, \qquad t = x - b, \qquad
          \Lambda = C^{-1} - B^{-1}, \qquad h = C^{-1} (\mu - b)

with c such that its integral with the prior is :math:`a_j`. Directions in which a part spreads as
the prior or wider tell nothing: there :math:`\Lambda` and h are 0.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

_MOST_PARTS = 8
_PAYS = 10.0  # by which a further part has to lower the criterion
_LEAST = 1e-6  # of the draws' variances, added to a part's


class Mixtures(NamedTuple):
    """Likelihoods of n members, of J parts each.

    centre : b (n, k), the mean of each member's prior.
    constant, slope, precision : c (n, J), h (n, J, k) and Lambda (n, J, k, k) of each part.
    """

    centre: Any
    constant: Any
    slope: Any
    precision: Any


def likelihood_of(
    draws: np.ndarray, log_prior: np.ndarray, prior: np.ndarray, rng: np.random.Generator
) -> Mixtures:
    """Return the likelihood of one member, without the axis of members.

    draws : (s, k), and log_prior : (s,) the log density of its prior there. prior : draws (r, k).
    """
    centre, covariance = prior.mean(axis=0), np.atleast_2d(np.cov(prior.T))
    back = np.linalg.inv(np.linalg.cholesky(covariance))
    white = (draws - centre) @ back.T
    log_weight = -0.5 * np.sum(white**2, axis=1) - log_prior
    weight = np.exp(log_weight - log_weight.max())
    rows = rng.choice(len(white), len(white), p=weight / weight.sum())
    parts = [_part(*part) for part in zip(*_fitted(white[rows], rng), strict=True)]
    constant, slope, precision = map(np.stack, zip(*parts, strict=True))
    return Mixtures(centre, constant, slope @ back, back.T @ precision @ back)


def _fitted(white: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return shares (J,), means (J, k) and covariances (J, k, k) of the parts."""
    seed = int(rng.integers(2**31))
    floor = _LEAST * float(np.mean(np.var(white, axis=0)))
    best, least = None, np.inf
    for parts in range(1, _MOST_PARTS + 1):
        mixture = GaussianMixture(parts, reg_covar=floor, random_state=seed)
        with warnings.catch_warnings():
            # A fit that has not ended is judged by its criterion like any other.
            warnings.simplefilter("ignore", ConvergenceWarning)
            mixture.fit(white)
        criterion = float(mixture.bic(white))
        if best is not None and criterion > least - _PAYS:
            break
        best, least = mixture, criterion
    assert best is not None
    return best.weights_, best.means_, best.covariances_


def _part(share: float, mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return constant, slope and precision of a part, where the prior is standard normal."""
    sizes, axes = np.linalg.eigh(covariance)
    precision = np.maximum(1.0 / sizes - 1.0, 0.0)
    slope = np.where(precision > 0.0, (axes.T @ mean) / sizes, 0.0)
    # The integral with the prior of each direction is (1 + p)^(-1/2) exp(h^2 / (1 + p) / 2).
    evidence = 0.5 * np.sum(slope**2 / (1.0 + precision) - np.log1p(precision))
    constant = np.log(share) - evidence
    return constant, axes @ slope, (axes * precision) @ axes.T


def stacked(members: list[Mixtures]) -> Mixtures:
    """Return the likelihoods of all members, with parts of no weight where others have more."""
    most = max(len(member.constant) for member in members)

    def padded(member: Mixtures) -> Mixtures:
        rest = most - len(member.constant)
        parts = [
            np.concatenate([values, np.full((rest, *values.shape[1:]), fill)])
            for values, fill in zip(member[1:], (-np.inf, 0.0, 0.0), strict=True)
        ]
        return Mixtures(member.centre, *parts)

    every = [padded(member) for member in members]
    return Mixtures(*(np.stack(arrays) for arrays in zip(*every, strict=True)))
