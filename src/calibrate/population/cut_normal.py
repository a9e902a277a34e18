r"""A normal distribution that is cut to an interval, by the normal score of a value.

.. math:: x = m + s\,\Phi^{-1}\big(\Phi(a) + \Phi(q)\,[\Phi(b) - \Phi(a)]\big), \qquad
          a = \frac{l - m}{s}, \quad b = \frac{h - m}{s}

takes a standard normal score :math:`q` to the normal of mean m and sd s, cut to (l, h): its
distribution function at x is :math:`\Phi(q)`. Where both ends are many sd away,
:math:`x = m + s q`. It is smooth in m, s and q, and never leaves the interval. Its slope is

.. math:: \frac{dx}{dq} = s\, \frac{\phi(q)}{\phi(t)}\, [\Phi(b) - \Phi(a)], \qquad t = (x - m) / s
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike

_LEAST = 1e-300  # a mass of which ndtri is finite
_FARTHEST = 30.0  # sd, beyond which a value's score is taken to be that of 30 sd


def from_score(
    score: jax.Array, mean: ArrayLike, sd: ArrayLike, low: ArrayLike, high: ArrayLike
) -> jax.Array:
    """Value in (``low``, ``high``) of normal ``score``; all broadcast, all in the value's unit.

    ``mean`` lies between ``low`` and ``high``.
    """
    a, b = (low - jnp.asarray(mean)) / sd, (high - jnp.asarray(mean)) / sd
    # Scores above 0 are counted from the upper end: 1 - 1e-17 is 1, 1e-17 is not 0.
    upper = score > 0.0
    q = jnp.where(upper, -score, score)
    near, far = jnp.where(upper, -b, a), jnp.where(upper, -a, b)
    mass = ndtr(near) + ndtr(q) * (ndtr(far) - ndtr(near))
    t = ndtri(jnp.maximum(mass, _LEAST))
    # Round-off may leave the interval by its last digit.
    return jnp.clip(mean + sd * jnp.where(upper, -t, t), low, high)


def to_score(
    value: jax.Array, mean: ArrayLike, sd: ArrayLike, low: ArrayLike, high: ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """Normal score q of ``value``, the inverse of :func:`from_score`, and the slope dx/dq there."""
    a, b = (low - jnp.asarray(mean)) / sd, (high - jnp.asarray(mean)) / sd
    t = jnp.clip((value - jnp.asarray(mean)) / sd, -_FARTHEST, _FARTHEST)
    upper = t > 0.0
    near, far = jnp.where(upper, -b, a), jnp.where(upper, -a, b)
    whole = ndtr(far) - ndtr(near)
    mass = (ndtr(jnp.where(upper, -t, t)) - ndtr(near)) / whole
    q = ndtri(jnp.maximum(mass, _LEAST))
    slope = jnp.asarray(sd) * whole * jnp.exp(0.5 * (t**2 - q**2))
    return jnp.where(upper, -q, q), slope
