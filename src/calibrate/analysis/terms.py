r"""Which terms of a law a test shows: all sets of terms, compared by their evidence.

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
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.special import log_ndtr, logsumexp
from scipy.stats import multivariate_normal

from calibrate.noise import information_about_means
from calibrate.statistical_model.model import Model
from emulator.core.display import TableRepr
from emulator.core.errors import InputError

MOST_TERMS = 5
"""Largest number of terms of a set."""
_PRESENT = 0.25  # prior probability of a term
_NOISES = 13  # sds of the noise, in equal ratios
_UNLIKELY = 9.0  # log evidence below the best from which a set is left out
_LISTED = 5  # sets that are told
_RIDGE = 1e-8  # of columns of length 1: two may be the same
_FAR = 8.0  # sds from zero at which a modulus is positive
_HOPELESS = -12.0  # log probability below which the integral is not asked
_LINEAR = 1e-6  # share of the data by which a linear map may miss the forward map


@dataclass(frozen=True, repr=False)
class Terms(TableRepr):
    """Which terms data show.

    probabilities : the posterior probability of each term, by its modulus.
    sets : the likeliest sets, and the probability of each.
    moduli : mean and sd of each modulus in kPa, where its term is present.
    noise : the posterior mean of the noise's size, as a factor of the model's.
    """

    probabilities: Mapping[str, float]
    sets: Sequence[tuple[tuple[str, ...], float]]
    moduli: Mapping[str, tuple[float, float]]
    noise: float

    @property
    def undecided(self) -> tuple[str, ...]:
        """Terms of which the data cannot tell whether they are there."""
        return tuple(name for name, p in self.probabilities.items() if 0.05 < p < 0.95)

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title and a row for each term, the likeliest first."""
        ranked = sorted(self.probabilities.items(), key=lambda item: -item[1])
        rows = []
        for name, probability in ranked:
            known = self.moduli.get(name)
            size = "" if known is None else f", {known[0]:.3g} +- {known[1]:.2g} kPa"
            rows.append((name, f"{probability:.3f}{size if probability > 0.05 else ''}"))
        if self.undecided:
            rows.append(("undecided", ", ".join(self.undecided)))
        return "Probability of each term", rows


def find_terms(model: Model, data: Mapping[str, Any] | np.ndarray) -> Terms:
    """Return which of the moduli of ``model``'s scene are not zero.

    Every unknown of the scene is such a modulus. The noise is the model's, its inferred sds in the
    ratio of their priors' scales, times a factor with a log-uniform prior between a thousandth and
    a third of the size of the data.

    Raises
    ------
    InputError
        Data that the map does not predict linearly in the unknowns, as where a free stretch depends
        on them; an unknown that is no modulus; noise that is not Gaussian; no data.
    """
    white = _whitening(model)
    y = white @ np.asarray(ravel_pytree(dict(model.check_data(data)))[0])
    G = white @ _design(model)
    if not y.size or not np.any(y):
        raise InputError("terms: all data are zero, or there are none")
    names = model.forward.scene.parameter_names
    seen = np.linalg.norm(G, axis=0) > 1e-9 * np.linalg.norm(G)
    return _compared(G[:, seen], y, [n for n, s in zip(names, seen, strict=True) if s], names)


def _whitening(model: Model) -> np.ndarray:
    """Return the matrix (n, n) that makes the noise independent, of sd 1."""
    scales = {}
    for name, noise in model.noise.items():
        if not noise.gaussian:
            raise InputError(f"terms: the noise of {name} must be Gaussian")
        # A half-normal prior's scale: its mean over that of a standard one.
        scales[name] = {
            key: prior.mean * np.sqrt(np.pi / 2.0) for key, prior in noise.priors.items()
        }
    means = {name: jnp.zeros(part.shape) for name, part in model.observe.parts.items()}
    information = np.asarray(information_about_means(model.noise, means, scales))
    return np.linalg.cholesky(information).T


def _design(model: Model) -> np.ndarray:
    """Return the data (n, p) that one unit of each modulus makes."""
    scene, observe, forward = model.forward.scene, model.observe, model.forward
    for parameter in scene.parameters:
        if parameter.unit != "kPa" or parameter.scale != "uniform":
            raise InputError(
                f"terms: '{parameter.name}' is no modulus on a uniform scale; make every unknown "
                "one in kPa, or a constant"
            )

    @jax.jit
    def predicted(theta: jax.Array) -> jax.Array:
        return ravel_pytree(observe(forward(theta)[None], theta[None]))[0]

    theta = scene.centre
    G = np.asarray(jax.jacfwd(predicted)(theta))
    for golden in (0.618, 0.382):  # uneven: equal factors of all moduli change no stretch
        other = scene.from_unit(golden * jnp.arange(1, len(theta) + 1) % 1.0)
        exact = np.asarray(predicted(other))
        if not np.abs(G @ np.asarray(other) - exact).max() <= _LINEAR * np.abs(exact).max():
            raise InputError(
                "terms: the data are not linear in the moduli; take an incompressible map and "
                "tests whose in-plane stretches are all measured"
            )
    return G


def _compared(G: np.ndarray, y: np.ndarray, names: Sequence[str], every: Sequence[str]) -> Terms:
    """Return the outcome for the columns ``names`` of G (n, p); terms not seen keep their prior."""
    size, p = float(np.sqrt(np.mean(y**2))), G.shape[1]
    units = np.linalg.norm(G, axis=0)
    least_squares = _LeastSquares((G / units).T @ (G / units), (G / units).T @ y, len(y))
    sets = [S for k in range(min(MOST_TERMS, p) + 1) for S in combinations(range(p), k)]
    counts = np.array([len(S) for S in sets])
    prior = counts * np.log(_PRESENT) + (p - counts) * np.log1p(-_PRESENT)
    fits = np.array([least_squares.explained(S) for S in sets])

    def log_evidence(sds: np.ndarray) -> np.ndarray:
        """Return the log evidence (sets, sds), ``-inf`` where it is hopeless."""
        logs = 0.5 * (fits[:, None] - np.sum(y**2)) / sds**2 - len(y) * np.log(sds)
        logs += (prior - 0.5 * counts * np.log1p(len(y)))[:, None]
        # The likeliest sets of moduli of any sign may need negative ones: the best is known last.
        found, best = np.full_like(logs, -np.inf), -np.inf
        most = logs + counts[:, None] * np.log(2.0)
        for place in np.argsort(-most, axis=None):
            i, j = np.unravel_index(place, logs.shape)
            if most[i, j] < best - _UNLIKELY:
                break
            found[i, j] = logs[i, j] + least_squares.log_positive(sets[i], sds[j])
            best = max(best, found[i, j])
        return found

    coarse = np.geomspace(1e-3 * size, size / 3.0, _NOISES)
    near = coarse[np.argmax(log_evidence(coarse).max(axis=0))]
    sds = np.geomspace(0.6 * near, near / 0.6, _NOISES)
    logs = log_evidence(sds)
    weights = np.exp(logs - logsumexp(logs))
    of_sets = weights.sum(axis=1)
    present = {
        name: float(sum(w for S, w in zip(sets, of_sets, strict=True) if k in S))
        for k, name in enumerate(names)
    }
    best = np.argsort(-of_sets)[:_LISTED]
    means = _moments(least_squares, sets, sds, weights)
    return Terms(
        {name: present.get(name, _PRESENT) for name in every},
        [(tuple(names[k] for k in sets[i]), float(of_sets[i])) for i in best],
        {names[k]: (mean / units[k], sd / units[k]) for k, (mean, sd) in means.items()},
        float(weights.sum(axis=0) @ sds),
    )


@dataclass(frozen=True)
class _LeastSquares:
    """The data's share in columns of length 1.

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
    chance = multivariate_normal.cdf(mean[near], mean=np.zeros(int(near.sum())), cov=block, rng=0)
    return min(float(np.log(max(float(chance), 1e-300))), bound)


def _moments(
    least_squares: _LeastSquares,
    sets: Sequence[tuple[int, ...]],
    sds: np.ndarray,
    weights: np.ndarray,
) -> dict[int, tuple[float, float]]:
    """Return mean and sd of each modulus where its term is present, signs not regarded."""
    sums = np.zeros((len(least_squares.projected), 3))
    for i, j in np.argwhere(weights > 1e-4 * weights.max()):
        if S := sets[i]:
            mean, inverse = least_squares.of(S)
            second = sds[j] ** 2 * np.diag(inverse) + mean**2
            sums[list(S)] += weights[i, j] * np.stack([np.ones(len(S)), mean, second], axis=1)
    found = {}
    for k in np.flatnonzero(sums[:, 0] > 0.0):
        mean, second = sums[k, 1:] / sums[k, 0]
        found[int(k)] = (float(mean), float(np.sqrt(max(second - mean**2, 0.0))))
    return found
