r"""FEM less the map, in the data's space, as a Gaussian process of theta.

FEM was solved at some theta; there the map misses the data's means by :math:`D`. Between them

.. math:: d(x) = k(x, X) (k(X, X) + \tau^2 I)^{-1} D, \quad
    k(x, x') = v (1 + x \cdot x') + \exp(-|x - x'|^2 / 2 \ell^2)

for all data at once, with theta standardised by its prior, :math:`x`, and a linear trend of wide
prior :math:`v`. :math:`\ell` and :math:`\tau` are chosen by leave-one-out errors, which for a
Gaussian process have a closed form (Rasmussen and Williams 2006, Eq. 5.12). Being wrong costs
precision, not honesty: FEM at fresh points weighs what the correction says
(:mod:`calibrate.certificate.check`).
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve

_LENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # in sd of the prior
_NUGGETS = (1e-6, 1e-4, 1e-2, 1.0, 1e2)
_TREND = 1e2
# A leave-one-out error below this fraction of the noise moves no posterior.
_NEGLIGIBLE = 1e-3


class Correction(NamedTuple):
    """A fitted process; zeros correct nothing.

    at : theta's features (n, q) where FEM was solved; rows may be padding.
    weights : of the kernel, (n, m); trend : offset and slopes, (q + 1, m); length : of the kernel.
    """

    at: np.ndarray
    weights: np.ndarray
    trend: np.ndarray
    length: float


def nothing(rows: int, features: int, data: int) -> Correction:
    """The correction that is zero, with room for ``rows`` points."""
    return Correction(
        np.zeros((rows, features)), np.zeros((rows, data)), np.zeros((features + 1, data)), 1.0
    )


def correct(correction: Correction, x: jax.Array) -> jax.Array:
    """The correction (m,) at features ``x`` (q,)."""
    distance = jnp.sum((correction.at - x) ** 2, axis=-1)
    kernel = jnp.exp(-0.5 * distance / correction.length**2)
    trend = correction.trend[0] + x @ correction.trend[1:]
    return trend + kernel @ correction.weights


def fit(x: np.ndarray, errors: np.ndarray, scales: np.ndarray, rows: int) -> Correction:
    """The process fitted to ``errors`` (n, m) at features ``x`` (n, q).

    Parameters
    ----------
    scales : noise level of each datum, (m,); leave-one-out errors are judged in it.
    rows : of the result, padded with zeros, so that programs are compiled once.
    """
    best, solution, length = np.inf, np.zeros_like(errors), 1.0
    linear = _TREND * (1.0 + x @ x.T)
    distances = ((x[:, None] - x) ** 2).sum(axis=-1)
    for trial, nugget in product(_LENGTHS, _NUGGETS):
        kernel = linear + np.exp(-0.5 * distances / trial**2) + nugget * np.eye(len(x))
        inverse = cho_solve(cho_factor(kernel), np.eye(len(x)))
        weights = inverse @ errors
        left_out = weights / np.diag(inverse)[:, None] / scales
        # Geometric mean over the points: the prior's corners must not outvote the posterior.
        loss = np.log(np.mean(left_out**2, axis=1) + _NEGLIGIBLE**2).mean()
        if loss < best:
            best, solution, length = loss, weights, trial
    result = nothing(rows, x.shape[1], errors.shape[1])
    result.at[: len(x)], result.weights[: len(x)] = x, solution
    trend = _TREND * np.vstack([solution.sum(axis=0), x.T @ solution])
    return result._replace(trend=trend, length=length)
