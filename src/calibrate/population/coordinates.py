r"""Coordinates of members in which a population is easy to sample.

A normal of mean m and sd s, cut to (l, h), has the normal score q of a value x,

.. math:: x = m + s\,\Phi^{-1}\big(\Phi(a) + \Phi(q)\,[\Phi(b) - \Phi(a)]\big), \qquad
          a = \frac{l - m}{s}, \quad b = \frac{h - m}{s}

so that its distribution function at x is :math:`\Phi(q)`. Where both ends are many sd away,
:math:`x = m + s q`. The map is smooth in m, s and q, and never leaves the interval. Its slope is

.. math:: \frac{dx}{dq} = s\, \frac{\phi(q)}{\phi(t)}\, [\Phi(b) - \Phi(a)], \qquad t = (x - m) / s

Given the population, :math:`x_i = x(q_i)` with scores :math:`q_i = L z_i`. A member without
informative data wants :math:`z_i` as its coordinates, one whose data fixes :math:`x_i` wants
:math:`x_i`: in the others the posterior is a funnel, or a thin sheet. Take the member's log
likelihood for quadratic around a value :math:`\bar x_i`, with slope :math:`g_i` and precision
:math:`\Lambda_i`, and :math:`x(q)` for linear around the score :math:`\bar q_i` of
:math:`\bar x_i`, with slopes :math:`D = \text{diag}(dx_k/dq_k)`. Then :math:`z_i` given the
population is Gaussian, and in

.. math:: z_i = P^{-1} L^T D\,(g_i + \Lambda_i D \bar q_i) + C^{-T} e_i, \qquad
          P = I + L^T D \Lambda_i D L = C C^T

:math:`e_i` is standard normal and independent of the population. The change of variables has the
determinant :math:`\prod_k C_{kk}^{-1}` and is exact for *any* :math:`\bar x_i`, :math:`g_i` and
:math:`\Lambda_i`; good ones make the posterior round. They come from the member's own posterior, by
dividing by its prior (both as Gaussians),

.. math:: \Lambda_i = A^{-1} - B^{-1}, \qquad g_i = B^{-1} (\bar x_i - \bar b_i)

with mean and covariance :math:`\bar x_i, A` of its draws and :math:`\bar b_i, B` of its prior's, in
the directions in which that is positive; elsewhere 0. A member without data has
:math:`e_i = z_i`. (Partial non-centring: Papaspiliopoulos, Roberts and Sköld 2007.)
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike

from emulator.core.small_matrices import eliminated

_LEAST = 1e-300  # least mass at which ndtri is finite
_FARTHEST = 30.0  # sd to which values farther from the mean are clipped


class Information(NamedTuple):
    """The information of each member's data on its shared unknowns, on their scales.

    value : the point (n, k) at which the log likelihood is expanded.
    slope, precision : its slope (n, k) there, and minus its Hessian (n, k, k).
    """

    value: jax.Array
    slope: jax.Array
    precision: jax.Array


class CutNormal(NamedTuple):
    """A population on the parameters' scales.

    mean, sd : mean and sd (k,) before the cut. low, high : both ends (k,) of the range.
    factor : the lower factor L (k, k) of the correlation of the scores.
    """

    mean: jax.Array
    sd: jax.Array
    low: jax.Array
    high: jax.Array
    factor: jax.Array


def from_score(
    score: jax.Array, mean: ArrayLike, sd: ArrayLike, low: ArrayLike, high: ArrayLike
) -> jax.Array:
    """Return the value in (``low``, ``high``) of a normal ``score``; all arguments broadcast.

    ``mean`` lies between ``low`` and ``high``.
    """
    a, b = (low - jnp.asarray(mean)) / sd, (high - jnp.asarray(mean)) / sd
    # Scores above 0 are counted from the upper end: 1 - 1e-17 is 1, 1e-17 is not 0.
    upper = score > 0.0
    q = jnp.where(upper, -score, score)
    lower_end, upper_end = jnp.where(upper, -b, a), jnp.where(upper, -a, b)
    mass = ndtr(lower_end) + ndtr(q) * (ndtr(upper_end) - ndtr(lower_end))
    t = ndtri(jnp.maximum(mass, _LEAST))
    # Round-off may leave the interval by its last digit.
    return jnp.clip(mean + sd * jnp.where(upper, -t, t), low, high)


def to_score(
    value: jax.Array, mean: ArrayLike, sd: ArrayLike, low: ArrayLike, high: ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """Return the normal score q of ``value``, the inverse of :func:`from_score`, and dx/dq."""
    a, b = (low - jnp.asarray(mean)) / sd, (high - jnp.asarray(mean)) / sd
    t = jnp.clip((value - jnp.asarray(mean)) / sd, -_FARTHEST, _FARTHEST)
    upper = t > 0.0
    lower_end, upper_end = jnp.where(upper, -b, a), jnp.where(upper, -a, b)
    total_mass = ndtr(upper_end) - ndtr(lower_end)
    mass = (ndtr(jnp.where(upper, -t, t)) - ndtr(lower_end)) / total_mass
    q = ndtri(jnp.maximum(mass, _LEAST))
    slope = jnp.asarray(sd) * total_mass * jnp.exp(0.5 * (t**2 - q**2))
    return jnp.where(upper, -q, q), slope


def information_of(draws: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return value (k,), slope (k,) and precision (k, k) from draws (s, k), and the prior's."""
    root = np.linalg.cholesky(np.atleast_2d(np.cov(prior.T)))
    whitened = np.linalg.solve(root, (draws - prior.mean(axis=0)).T)
    sizes, axes = np.linalg.eigh(np.atleast_2d(np.cov(whitened)))
    # Directions in which draws happen to spread more than the prior are left out.
    precision = np.maximum(1.0 / np.maximum(sizes, 1e-12) - 1.0, 0.0)
    shift = np.where(precision > 0.0, axes.T @ whitened.mean(axis=1), 0.0)
    back = np.linalg.solve(root.T, axes)
    return draws.mean(axis=0), back @ shift, (back * precision) @ back.T


def scores_of(
    e: jax.Array, information: Information, population: CutNormal
) -> tuple[jax.Array, jax.Array]:
    """Return scores z (n, k) at coordinates ``e`` (n, k), and the log determinant of dz/de, ()."""
    z, log_determinants = jax.vmap(_scores_of_member, in_axes=(0, 0, None))(
        e, information, population
    )
    return z, jnp.sum(log_determinants)


def _scores_of_member(
    e: jax.Array, information: Information, population: CutNormal
) -> tuple[jax.Array, jax.Array]:
    *cut, factor = population
    score, slope = to_score(information.value, *cut)
    root = slope[:, None] * factor
    P = jnp.eye(len(e)) + root.T @ information.precision @ root
    gradient = information.slope + information.precision @ (slope * score)
    # P = L diag(pivots) L^T, so that C = L diag(sqrt(pivots)).
    pivots, inverse_L = eliminated(P, jnp.eye(len(e)))
    inverse_C = inverse_L / jnp.sqrt(pivots)[:, None]
    z = inverse_C.T @ (inverse_C @ (root.T @ gradient) + e)
    return z, -0.5 * jnp.sum(jnp.log(pivots))
