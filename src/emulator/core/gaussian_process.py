r"""Gaussian processes: correlation functions, and regression on values and on derivatives.

**Regression.** Observations y at inputs X, of covariance K with their noise, have the mean
:math:`k(x, X)\, K^{-1} y` at another input x (Rasmussen and Williams 2006, Equation 2.25).

**Correlations.** A correlation function gives the correlation of two points at the squared distance
:math:`\rho`, in units of the length scales:

.. math::
    \text{squared exponential:} \quad & e^{-\rho/2} \\
    \text{Mat\'ern 3/2:} \quad & (1 + a)\, e^{-a}, \qquad a = \sqrt{3\rho} \\
    \text{Mat\'ern 7/2:} \quad & \left(1 + a + \tfrac25 a^2 + \tfrac1{15} a^3\right) e^{-a},
        \qquad a = \sqrt{7\rho}

(Rasmussen and Williams 2006, Equations 4.9 and 4.16).

**Derivatives.** The regression on values and derivatives takes Matern 7/2, three times
differentiable, of the distance between features :math:`\psi` of two inputs,

.. math:: \rho = |\delta|^2, \qquad \delta = \Lambda\,[\psi(x) - \psi(y)],

scaled by inverse lengths :math:`\Lambda`. With :math:`J = \Lambda\,\partial\psi`,

.. math::
    \partial_y \kappa = -2\kappa'\, \delta J_y, \qquad
    \partial_x \partial_y \kappa
        = -4 \kappa''\, (\delta J_x)(\delta J_y)^T - 2\kappa'\, J_x^T J_y, \\
    \kappa' = -\tfrac7{10}\left(1 + a + \tfrac13 a^2\right) e^{-a}, \quad
    \kappa'' = \tfrac{49}{60}(1 + a) e^{-a}, \quad
    \kappa''' = -\tfrac{343}{120} e^{-a}

so that a run's value and its p derivatives are p + 1 observations. None of these is singular where
two inputs coincide (Solak et al. 2003; Rasmussen and Williams 2006, Section 9.4). JAX is given them
as differentiation rules: differentiating the root itself would lose four digits there.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from emulator.core.minimise import minimise

JITTER = 1e-9  # added to the variance 1 of each observation, because FEM has no noise
_LOG_LOW, _LOG_HIGH = -6.0, 3.0  # of the logarithms of inverse lengths; inputs are of order 1


def squared_exponential(squared: Any) -> Any:
    """Return the squared exponential correlation at squared scaled distances of any shape.

    Like :func:`matern32`, it computes with NumPy where the distances are NumPy's, else with JAX.
    """
    return _library(squared).exp(-0.5 * squared)


def matern32(squared: Any) -> Any:
    """Return Matern's correlation of smoothness 3/2 at squared scaled distances of any shape."""
    xp = _library(squared)
    a = xp.sqrt(3.0 * squared)
    return (1.0 + a) * xp.exp(-a)


def _library(values: Any) -> Any:
    return np if isinstance(values, np.ndarray) else jnp


def _linalg(values: Any) -> Any:
    # Not NumPy's: its BLAS has threads of its own, which would wait beside SciPy's.
    return scipy.linalg if isinstance(values, np.ndarray) else jax.scipy.linalg


CORRELATIONS: dict[str, Callable[[Any], Any]] = {
    "matern32": matern32,
    "squared_exponential": squared_exponential,
}
"""Correlation functions that options call by name."""


class Regression(NamedTuple):
    """The regression on n observations; it computes with NumPy where its arrays are NumPy's.

    factor : the lower Cholesky factor (n, n) of their covariance K, which includes their noise.
    """

    factor: Any

    @classmethod
    def of(cls, covariance: Any) -> Regression:
        """Return the regression on observations of this covariance (n, n)."""
        return cls(_linalg(covariance).cholesky(covariance, lower=True))

    def weights(self, observations: Any) -> Any:
        """Return K^-1 y of observations y (n, ...); times k(x, X) they are the mean at x."""
        return _linalg(self.factor).cho_solve((self.factor, True), observations)

    def whitened(self, observations: Any) -> Any:
        """Return observations y (n, ...) without their covariance, L^-1 y."""
        return _linalg(self.factor).solve_triangular(self.factor, observations, lower=True)

    def inverse(self) -> Any:
        """Return K^-1, (n, n)."""
        return self.weights(_library(self.factor).eye(len(self.factor)))


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def matern72(squared: jax.Array, order: int = 0) -> jax.Array:
    """Return Matern 7/2, or its first or second derivative, at squared scaled distances.

    It is smooth where they are zero.
    """
    a = _root(squared)
    if order == 0:
        return (1.0 + a + 0.4 * a**2 + a**3 / 15.0) * jnp.exp(-a)
    if order == 1:
        return -0.7 * (1.0 + a + a**2 / 3.0) * jnp.exp(-a)
    return 49.0 / 60.0 * (1.0 + a) * jnp.exp(-a)


@matern72.defjvp
def _matern72_slope(order: int, squared: Any, change: Any) -> tuple[jax.Array, jax.Array]:
    third = lambda s, _: -343.0 / 120.0 * jnp.exp(-_root(s))  # noqa: E731
    derivative = (third if order == 2 else matern72)(squared[0], order + 1)
    return matern72(squared[0], order), derivative * change[0]


def _root(squared: jax.Array) -> jax.Array:
    return jnp.sqrt(7.0 * squared + 1e-24)  # the root's own derivative is infinite at zero


class Features(NamedTuple):
    """Features of c inputs, (c, q), and their derivatives in the inputs, (c, q, p)."""

    value: jax.Array
    derivative: jax.Array

    def scaled(self, inverse_lengths: jax.Array) -> Features:
        """Return the features divided by the length scales, whose inverses (q,) are given."""
        return Features(self.value * inverse_lengths, self.derivative * inverse_lengths[:, None])


def covariance(features: Features) -> jax.Array:
    """Return the covariance (c (1 + p), c (1 + p)) of values and derivatives at scaled features."""
    psi, J = features
    count, parameters = len(psi), J.shape[2]
    gap = psi[:, None] - psi[None]
    squared = jnp.sum(gap**2, axis=-1)
    value, first, second = (matern72(squared, order) for order in range(3))
    left = jnp.einsum("ijq,iqa->ija", gap, J)  # delta J_x
    right = jnp.einsum("ijq,jqb->ijb", gap, J)
    crossed = -4.0 * second[..., None, None] * left[..., :, None] * right[..., None, :]
    crossed += -2.0 * first[..., None, None] * jnp.einsum("iqa,jqb->ijab", J, J)
    top = jnp.concatenate([value[..., None], -2.0 * first[..., None] * right], axis=-1)
    rest = jnp.concatenate([2.0 * first[..., None, None] * left[..., None], crossed], axis=-1)
    blocks = jnp.concatenate([top[:, :, None], rest], axis=2)
    return blocks.transpose(0, 2, 1, 3).reshape([count * (1 + parameters)] * 2)


def _standardised(features: Features) -> tuple[jax.Array, Regression]:
    """Return prior standard deviations (N,), and the regression on observations in their units."""
    K = covariance(features)
    sd = jnp.sqrt(jnp.diagonal(K))
    return sd, Regression.of(K / sd[:, None] / sd + JITTER * jnp.eye(len(K)))


def negative_log_likelihood(features: Features, observations: jax.Array) -> jax.Array:
    """Return the negative log likelihood per observed number, up to a constant.

    features : the scaled features of c inputs.
    observations : values and derivatives of r outputs, input by input, (c (1 + p), r). The variance
        of each output is its most likely one, the mean square of its whitened observations.
    """
    sd, regression = _standardised(features)
    white = regression.whitened(observations / sd[:, None])
    variances = jnp.mean(white**2, axis=0)
    determinant = jnp.mean(jnp.log(jnp.diagonal(regression.factor)) + jnp.log(sd))
    return 0.5 * jnp.mean(jnp.log(variances)) + determinant


def fit_lengths(features: Features, observations: jax.Array) -> np.ndarray:
    """Return the most likely inverse lengths (q,).

    features : not yet scaled. observations : as in :func:`negative_log_likelihood`.
    """

    @jax.jit
    @jax.value_and_grad
    def objective(logs: jax.Array) -> jax.Array:
        return negative_log_likelihood(features.scaled(jnp.exp(logs)), observations)

    start = np.zeros(features.value.shape[1])
    start[features.derivative.shape[2] :] = -1.0
    return np.exp(minimise(objective, start, low=_LOG_LOW, high=_LOG_HIGH, iterations=80).x)


def fit_weights(features: Features, observations: jax.Array) -> jax.Array:
    """Return the weights (c (1 + p), r) with which the mean passes through the observations."""
    sd, regression = _standardised(features)
    return regression.weights(observations / sd[:, None]) / sd[:, None]


def fold(features: Features, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Split weights into weights of values (c, r) and of derivatives by feature (c, q, r).

    A derivative in position acts through the features' derivatives, so its p weights are q here.
    """
    count, _, parameters = features.derivative.shape
    of_run = weights.reshape(count, 1 + parameters, -1)
    return of_run[:, 0], jnp.einsum("cqp,cpr->cqr", features.derivative, of_run[:, 1:])


def mean(
    at: jax.Array, known: jax.Array, value_weights: jax.Array, derivative_weights: jax.Array
) -> jax.Array:
    """Return the posterior mean (r,) at scaled features ``at`` (q,).

    known : the scaled features of the observed inputs, (c, q).
    value_weights, derivative_weights : the weights (c, r) and (c, q, r) from :func:`fold`.
    """
    gap = at - known
    squared = jnp.sum(gap**2, axis=-1)
    count, width, outputs = derivative_weights.shape
    along = (-2.0 * matern72(squared, 1)[:, None] * gap).reshape(count * width)
    return matern72(squared) @ value_weights + along @ derivative_weights.reshape(
        count * width, outputs
    )
