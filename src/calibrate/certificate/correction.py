r"""FEM less the map, in the data's space, as a Gaussian process of theta.

FEM was solved at some theta; there the map misses the data's means by :math:`D`. Between them

.. math:: d(x) = k(x, X) (k(X, X) + \tau^2 I)^{-1} D, \quad
    k(x, x') = v (1 + x \cdot x') + \exp(-|x - x'|^2 / 2 \ell^2)

for all data at once, with theta standardised by its prior, :math:`x`, and a linear trend of wide
prior :math:`v`. :math:`\ell` and :math:`\tau` are chosen by leave-one-out errors, which for a
Gaussian process have a closed form (Rasmussen and Williams 2006, Eq. 5.10-5.12). Their size also
sets the scale :math:`a^2` of the process's variance, in squared noise sd,

.. math:: v(x) = a^2 (k(x, x) + \tau^2 - k(x, X) (k(X, X) + \tau^2 I)^{-1} k(X, x))

Being wrong costs precision where FEM is asked: :math:`v` only says where to look, and FEM at fresh
points weighs what the correction says (:mod:`calibrate.certificate.check`). Where no point looks,
nothing is known; so descents of FEM's own misfit look (:mod:`calibrate.certificate.descents`). And
no correction at all is one of the candidates: a process that a bump far from the posterior spoils
everywhere is worse than none.
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
    r"""A fitted process; zeros correct nothing.

    at : theta's features (n, q) where FEM was solved; rows may be padding.
    weights : of the kernel, (n, m), zero in rows of padding.
    inverse : of the kernel matrix, (n, n).
    length, nugget, scale : of the kernel, :math:`\\ell`, :math:`\\tau^2` and :math:`a^2`.
    """

    at: np.ndarray
    weights: np.ndarray
    inverse: np.ndarray
    length: float
    nugget: float
    scale: float


def nothing(rows: int, features: int, data: int) -> Correction:
    """The correction that is zero, with room for ``rows`` points."""
    at, weights, inverse = (np.zeros((rows, width)) for width in (features, data, rows))
    return Correction(at, weights, inverse, length=1.0, nugget=0.0, scale=0.0)


def correct(correction: Correction, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The correction (m,) at features ``x`` (q,), and its variance () in squared noise sd."""
    c = correction
    distance = jnp.sum((c.at - x) ** 2, axis=-1)
    kernel = _TREND * (1.0 + c.at @ x) + jnp.exp(-0.5 * distance / c.length**2)
    here = _TREND * (1.0 + x @ x) + 1.0 + c.nugget
    variance = c.scale * jnp.maximum(here - kernel @ c.inverse @ kernel, c.nugget)
    return kernel @ c.weights, variance


@jax.jit
def corrections(correction: Correction, x: jax.Array) -> jax.Array:
    """The correction (s, m) at features ``x`` (s, q)."""
    return jax.vmap(lambda one: correct(correction, one)[0])(x)


def fit(
    x: np.ndarray,
    errors: np.ndarray,
    scales: np.ndarray,
    rows: int,
    likely: np.ndarray | None = None,
) -> Correction:
    """The process fitted to ``errors`` (n, m) at features ``x`` (n, q); none where that is better.

    Parameters
    ----------
    scales : noise level of each datum, (m,); leave-one-out errors are judged in it.
    rows : of the result, padded with zeros, so that programs are compiled once.
    likely : (n,) bool, points at which the process has to be better than none; all by default.
    """
    none, result = (nothing(rows, x.shape[1], errors.shape[1]) for _ in range(2))
    result.at[: len(x)] = x
    linear = _TREND * (1.0 + x @ x.T)
    plain = np.mean((errors / scales) ** 2, axis=1)
    judged = slice(None) if likely is None or not likely.any() else likely
    best, there = np.inf, np.inf
    distances = ((x[:, None] - x) ** 2).sum(axis=-1)
    for trial, nugget in product(_LENGTHS, _NUGGETS):
        kernel = linear + np.exp(-0.5 * distances / trial**2) + nugget * np.eye(len(x))
        inverse = cho_solve(cho_factor(kernel), np.eye(len(x)))
        weights = inverse @ errors
        # Leave-one-out errors in noise sd, and their variances up to a^2.
        square = np.mean((weights / np.diag(inverse)[:, None] / scales) ** 2, axis=1)
        variance = 1.0 / np.diag(inverse)
        # Geometric mean over the points: the prior's corners must not outvote the posterior.
        loss = np.log(square + _NEGLIGIBLE**2).mean()
        if loss < best:
            best, there = loss, np.log(square[judged] + _NEGLIGIBLE**2).mean()
            result.weights[: len(x)], result.inverse[: len(x), : len(x)] = weights, inverse
            result = result._replace(
                length=trial, nugget=nugget, scale=float(np.mean(square / variance))
            )
    if there < np.log(plain[judged] + _NEGLIGIBLE**2).mean():
        return result
    return none._replace(scale=float(np.mean(plain / (np.diag(linear) + 1.0))))
