r"""Gaussian processes of values and derivatives, several outputs sharing one kernel.

The kernel is Matérn's of smoothness 7/2 (three times differentiable) of the squared distance

.. math:: \rho = |\Lambda\,[\psi(x) - \psi(y)]|^2, \qquad
          a = \sqrt{7\rho}, \qquad
          \kappa = \left(1 + a + \tfrac25 a^2 + \tfrac1{15} a^3\right) e^{-a}

between features :math:`\psi` of two inputs, scaled by inverse lengths :math:`\Lambda`. With
:math:`\delta = \Lambda[\psi(x) - \psi(y)]` and :math:`J = \Lambda\,\partial\psi`,

.. math::
    \partial_y \kappa = -2\kappa'\, \delta J_y, \qquad
    \partial_x \partial_y \kappa
        = -4 \kappa''\, (\delta J_x)(\delta J_y)^T - 2\kappa'\, J_x^T J_y, \\
    \kappa' = -\tfrac7{10}\left(1 + a + \tfrac13 a^2\right) e^{-a}, \quad
    \kappa'' = \tfrac{49}{60}(1 + a) e^{-a}, \quad
    \kappa''' = -\tfrac{343}{120} e^{-a}

so a run's value and p derivatives are p + 1 observations. None of these is singular where two
inputs coincide (Solak et al. 2003; Rasmussen & Williams 2006, Section 9.4). JAX is given them as
differentiation rules: differentiating the root itself would lose four digits there.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize

JITTER = 1e-9  # of observations of unit variance; FEM has no noise
_LOG_BOUNDS = (-6.0, 3.0)  # of inverse lengths, inputs being of order one


class Features(NamedTuple):
    """Features (c, q) of c inputs and their derivatives (c, q, p), scaled or not."""

    value: jax.Array
    derivative: jax.Array

    def scaled(self, inverse_lengths: jax.Array) -> Features:
        """Features and derivatives divided by their lengths."""
        return Features(self.value * inverse_lengths, self.derivative * inverse_lengths[:, None])


class Radial(NamedTuple):
    """The kernel and its first two derivatives in the squared distance."""

    value: jax.Array
    first: jax.Array
    second: jax.Array


def radial(squared: jax.Array) -> Radial:
    """Matern 7/2 at squared distances of any shape; smooth where they are zero."""
    return Radial(_value(squared), _first(squared), _second(squared))


def _root(squared: jax.Array) -> jax.Array:
    return jnp.sqrt(7.0 * squared + 1e-24)  # the root's own derivative is infinite at zero


@jax.custom_jvp
def _value(squared: jax.Array) -> jax.Array:
    a = _root(squared)
    return (1.0 + a + 0.4 * a**2 + a**3 / 15.0) * jnp.exp(-a)


@jax.custom_jvp
def _first(squared: jax.Array) -> jax.Array:
    a = _root(squared)
    return -0.7 * (1.0 + a + a**2 / 3.0) * jnp.exp(-a)


@jax.custom_jvp
def _second(squared: jax.Array) -> jax.Array:
    a = _root(squared)
    return 49.0 / 60.0 * (1.0 + a) * jnp.exp(-a)


_value.defjvps(lambda change, _, squared: _first(squared) * change)
_first.defjvps(lambda change, _, squared: _second(squared) * change)
_second.defjvps(lambda change, _, squared: -343.0 / 120.0 * jnp.exp(-_root(squared)) * change)


def covariance(features: Features) -> jax.Array:
    """Covariance (c (1 + p), c (1 + p)) of the runs' values and derivatives, features scaled."""
    psi, J = features
    count, parameters = len(psi), J.shape[2]
    gap = psi[:, None] - psi[None]
    k = radial(jnp.sum(gap**2, axis=-1))
    left = jnp.einsum("ijq,iqa->ija", gap, J)  # delta J_x
    right = jnp.einsum("ijq,jqb->ijb", gap, J)
    crossed = -4.0 * k.second[..., None, None] * left[..., :, None] * right[..., None, :]
    crossed += -2.0 * k.first[..., None, None] * jnp.einsum("iqa,jqb->ijab", J, J)
    top = jnp.concatenate([k.value[..., None], -2.0 * k.first[..., None] * right], axis=-1)
    rest = jnp.concatenate([2.0 * k.first[..., None, None] * left[..., None], crossed], axis=-1)
    blocks = jnp.concatenate([top[:, :, None], rest], axis=2)
    return blocks.transpose(0, 2, 1, 3).reshape([count * (1 + parameters)] * 2)


def _factor(features: Features) -> tuple[jax.Array, jax.Array]:
    """Prior standard deviations (N,) of the observations, and the factor of their correlations."""
    K = covariance(features)
    sd = jnp.sqrt(jnp.diagonal(K))
    correlation = K / sd[:, None] / sd + JITTER * jnp.eye(len(K))
    return sd, jnp.linalg.cholesky(correlation)


def misfit(features: Features, observations: jax.Array) -> jax.Array:
    """Negative log-likelihood per observed number, up to a constant, of scaled features.

    Each output has its most likely variance, the mean square of its whitened observations.
    """
    sd, factor = _factor(features)
    white = solve_triangular(factor, observations / sd[:, None], lower=True)
    variances = jnp.mean(white**2, axis=0)
    determinant = jnp.mean(jnp.log(jnp.diagonal(factor)) + jnp.log(sd))
    return 0.5 * jnp.mean(jnp.log(variances)) + determinant


def fit_lengths(features: Features, observations: jax.Array) -> np.ndarray:
    """Inverse lengths (q,) of greatest likelihood, each output's variance profiled out.

    Parameters
    ----------
    observations : (c (1 + p), r) values and derivatives of r outputs, run by run.
    """

    @jax.jit
    @jax.value_and_grad
    def objective(logs: jax.Array) -> jax.Array:
        return misfit(features.scaled(jnp.exp(logs)), observations)

    def safe(logs: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = (np.asarray(part) for part in objective(jnp.asarray(logs)))
        if np.isfinite(value) and np.isfinite(gradient).all():
            return float(value), gradient
        return 1e10, np.zeros_like(logs)  # so high that the line search rejects the step

    count = features.value.shape[1]
    start = np.zeros(count)
    start[features.derivative.shape[2] :] = -1.0
    found = minimize(
        safe, start, jac=True, method="L-BFGS-B", bounds=[_LOG_BOUNDS] * count,
        options={"maxiter": 80},
    )  # fmt: skip
    return np.exp(found.x)


def fit_weights(features: Features, observations: jax.Array) -> jax.Array:
    """Weights (c (1 + p), r) that make the mean pass through the observations."""
    sd, factor = _factor(features)
    return cho_solve((factor, True), observations / sd[:, None]) / sd[:, None]


def fold(features: Features, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Weights of the values (c, r), and of the derivatives in feature space (c, q, r).

    A derivative in position acts through the features' derivatives, so its p weights are q here.
    """
    count, _, parameters = features.derivative.shape
    each = weights.reshape(count, 1 + parameters, -1)
    return each[:, 0], jnp.einsum("cqp,cpr->cqr", features.derivative, each[:, 1:])


def mean(
    at: jax.Array, known: jax.Array, value_weights: jax.Array, derivative_weights: jax.Array
) -> jax.Array:
    """Posterior mean (r,) at scaled features ``at`` (q,).

    known : (c, q) scaled features of the runs. Weights (c, r) and (c, q, r) : :func:`fold`.
    """
    gap = at - known
    k = radial(jnp.sum(gap**2, axis=-1))
    count, width, outputs = derivative_weights.shape
    along = (-2.0 * k.first[:, None] * gap).reshape(count * width)
    return k.value @ value_weights + along @ derivative_weights.reshape(count * width, outputs)
