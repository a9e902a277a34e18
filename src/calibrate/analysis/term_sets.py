r"""All sets of a law's terms, compared by the evidence of data that are linear in their moduli.

Data that are linear in moduli c, each of which is zero or positive,

.. math::
    y = G c + \varepsilon, \quad \varepsilon \sim N(0, \sigma^2 I_n), \qquad
    c_k = 0 \text{ with probability } 1 - \pi, \text{ else } c_k > 0 .

Correlated errors are whitened first. With the least-squares moduli :math:`\hat c` of a set S of
terms and :math:`A = G_S^T G_S / \sigma^2`, the prior of its moduli has the information of one of
the n data (Kass and Wasserman 1995), :math:`N(\hat c, n A^{-1})` where all are positive. It needs
no scale of anybody's choice, and the evidence is in closed form up to the probabilities
:math:`\Phi^+` that normal vectors are positive,

.. math::
    \frac{p(y \mid S, \sigma)}{N(y; 0, \sigma^2 I)} =
        e^{\frac12 \hat c^T A \hat c}\; (1 + n)^{-|S| / 2}\;
        \frac{\Phi^+(\hat c, A^{-1} n / (n + 1))}{\Phi^+(\hat c, A^{-1} n)} .

All sets of up to five terms are compared, over a grid of :math:`\log\sigma`, so no chain has to
find the way between sets that explain the data alike. The probability of a term is the sum over
the sets that have it; where two terms do the same, each gets a part, and neither is near 0 or 1.

Other data are predicted by draws of the moduli, which are :math:`N(\hat c, A^{-1} n / (n + 1))`
where all are positive. Few sets of any probability need more draws than are tried: of those, draws
that miss least are taken, and negative moduli are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtr
from scipy.stats import multivariate_normal

MOST_TERMS = 5
"""Largest number of terms of a set."""
PRESENT = 0.25
"""Prior probability of a term."""
_NOISES = 13  # sds of the noise, in equal ratios
_UNLIKELY = 9.0  # log evidence below the best from which a set is left out
_TRIES, _DRAWS = 20_000, 200  # normal draws of a set's moduli, and positive ones that are taken
_RIDGE = 1e-8  # of columns of length 1: two may be the same
_FAR = 8.0  # sds from zero at which a modulus is positive
_HOPELESS = -12.0  # log probability below which the integral is not asked
_PRECISE = 1e-4  # error of the integral


def seen_columns(G: np.ndarray) -> np.ndarray:
    """Return the columns of G (n, p) that are not zero."""
    return np.flatnonzero(np.linalg.norm(G, axis=0) > 1e-9 * np.linalg.norm(G))


def posterior_of_sets(G: np.ndarray, y: np.ndarray, names: Sequence[str]) -> SetPosterior:
    """Return the posterior probability of every subset of candidate terms.

    Columns of the design matrix G (n, p) that are zero are left out, with their ``names``.
    """
    seen = seen_columns(G)
    G, names = G[:, seen], [names[k] for k in seen]
    size, p = float(np.sqrt(np.mean(y**2))), G.shape[1]
    units = np.linalg.norm(G, axis=0)
    least_squares = _LeastSquares((G / units).T @ (G / units), (G / units).T @ y, len(y))
    sets = [S for k in range(min(MOST_TERMS, p) + 1) for S in combinations(range(p), k)]
    counts = np.array([len(S) for S in sets])
    prior = counts * np.log(PRESENT) + (p - counts) * np.log1p(-PRESENT)
    fits = np.array([least_squares.explained(S) for S in sets])

    def log_evidence(sds: np.ndarray, within: float) -> np.ndarray:
        """Return the log evidence (sets, sds), ``-inf`` where it is not ``within`` of the best."""
        logs = 0.5 * (fits[:, None] - np.sum(y**2)) / sds**2 - len(y) * np.log(sds)
        logs += (prior - 0.5 * counts * np.log1p(len(y)))[:, None]
        # The likeliest sets of moduli of any sign may need negative ones: the best is known last.
        evidence, best = np.full_like(logs, -np.inf), -np.inf
        most = logs + counts[:, None] * np.log(2.0)
        for place in np.argsort(-most, axis=None):
            i, j = np.unravel_index(place, logs.shape)
            if most[i, j] < best - within:
                break
            evidence[i, j] = logs[i, j] + least_squares.log_positive(sets[i], sds[j])
            best = max(best, evidence[i, j])
        return evidence

    coarse = np.geomspace(1e-3 * size, size / 3.0, _NOISES)
    near = coarse[np.argmax(log_evidence(coarse, 0.0).max(axis=0))]
    reach = 0.6 ** max(1.0, 6.0 / np.sqrt(len(y)))  # few data leave the noise's size open
    sds = np.geomspace(reach * near, min(near / reach, max(near / 0.6, coarse[-1])), _NOISES)
    logs = log_evidence(sds, _UNLIKELY)
    return SetPosterior(names, units, least_squares, sets, sds, np.exp(logs - logsumexp(logs)))


@dataclass(frozen=True)
class SetPosterior:
    """The probabilities of all sets of terms.

    names, units : the terms (p,), and the lengths of their columns.
    least_squares : the data's share in columns of length 1.
    sets, sds, weights : the sets, the noise's sds, and the probabilities (sets, sds).
    """

    names: Sequence[str]
    units: np.ndarray
    least_squares: _LeastSquares
    sets: Sequence[tuple[int, ...]]
    sds: np.ndarray
    weights: np.ndarray

    @property
    def of_sets(self) -> np.ndarray:
        """The probability of each set."""
        return self.weights.sum(axis=1)

    @property
    def of_terms(self) -> dict[str, float]:
        """The probability of each term."""
        chances = [
            sum(w for S, w in zip(self.sets, self.of_sets, strict=True) if k in S)
            for k in range(len(self.names))
        ]
        return {name: float(p) for name, p in zip(self.names, chances, strict=True)}

    def terms(self, i: int) -> tuple[str, ...]:
        """Return the names of the terms of the set numbered i."""
        return tuple(self.names[k] for k in self.sets[i])

    @property
    def noise(self) -> float:
        """The mean of the noise's sd."""
        return float(self.weights.sum(axis=0) @ self.sds)

    @property
    def moments(self) -> dict[str, tuple[float, float]]:
        """Mean and sd in kPa of each modulus given that its term is present, without its sign."""
        sums = np.zeros((len(self.names), 3))
        for i, j in np.argwhere(self.weights > 1e-4 * self.weights.max()):
            if S := list(self.sets[i]):
                mean, inverse = self.least_squares.of(S)
                second = self.sds[j] ** 2 * np.diag(inverse) + mean**2
                sums[S] += self.weights[i, j] * np.stack([np.ones(len(S)), mean, second], axis=1)
        moments = {}
        for k in np.flatnonzero(sums[:, 0] > 0.0):
            mean, second = sums[k, 1:] / sums[k, 0]
            sd = np.sqrt(max(second - mean**2, 0.0))
            moments[self.names[int(k)]] = float(mean / self.units[k]), float(sd / self.units[k])
        return moments

    def predicted(self, i: int, data: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, ...]:
        """Predict other data (k,) by the set numbered i, in sds of their noise.

        Return the mean, the probability of less and the log density of each point, (k,).

        columns : the data (k, p) that one unit of each modulus makes.
        """
        rng, S, n = np.random.default_rng(0), list(self.sets[i]), self.least_squares.count
        chances = self.weights[i] if self.weights[i].any() else self.weights.sum(axis=0)
        sds = rng.choice(self.sds, (_TRIES, 1), p=chances / chances.sum())
        mean, inverse = self.least_squares.of(S)
        steps = rng.normal(size=(_TRIES, len(S))) @ np.linalg.cholesky(inverse).T
        moduli = mean + sds * steps * np.sqrt(n / (n + 1.0))
        misses = (moduli / np.sqrt(np.diag(inverse))).min(axis=1, initial=0.0)
        chosen = np.argsort(-misses, kind="stable")[:_DRAWS]  # positive ones, or the nearest to it
        means = np.maximum(moduli[chosen], 0.0) / self.units[S] @ columns[:, S].T
        z = (data - means) / sds[chosen]
        logs = -0.5 * z**2 - np.log(sds[chosen] * _DRAWS * np.sqrt(2.0 * np.pi))
        return means.mean(axis=0), ndtr(z).mean(axis=0), logsumexp(logs, axis=0)


@dataclass(frozen=True)
class _LeastSquares:
    """The normal equations of the data in columns of length 1.

    gram : G^T G, (p, p). projected : G^T y, (p,). count : the number n of data.
    """

    gram: np.ndarray
    projected: np.ndarray
    count: int

    def of(self, S: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return least-squares moduli of any sign, and their covariance at a noise of sd 1."""
        rows = list(S)
        inverse = np.linalg.inv(self.gram[np.ix_(rows, rows)] + _RIDGE * np.eye(len(rows)))
        return inverse @ self.projected[rows], inverse

    def explained(self, S: Sequence[int]) -> float:
        """Return the part of the data's square that the terms explain."""
        return float(self.of(S)[0] @ self.projected[list(S)]) if S else 0.0

    def log_positive(self, S: Sequence[int], sd: float) -> float:
        """Return the log probability that all moduli are positive, over that of the prior."""
        if not S:
            return 0.0
        mean, inverse = self.of(S)
        n = float(self.count)
        covariance = sd**2 * inverse
        return _log_orthant(mean, covariance * n / (n + 1.0)) - _log_orthant(mean, covariance * n)


def _log_orthant(mean: np.ndarray, covariance: np.ndarray) -> float:
    """Return the log probability that a normal vector (k,) is positive.

    It is no more than that of each entry, which is exact where the integral's own error is larger.
    """
    far = mean / np.sqrt(np.diag(covariance))
    near, bound = far < _FAR, float(log_ndtr(far).min())  # the others are positive
    if near.sum() <= 1 or bound < _HOPELESS:
        return bound
    block = covariance[np.ix_(near, near)]
    chance = multivariate_normal.cdf(
        mean[near], mean=np.zeros(int(near.sum())), cov=block, abseps=_PRECISE, rng=0
    )
    return min(float(np.log(max(float(chance), 1e-300))), bound)
