r"""A transport map: the change of variables that straightens curved ridges of the posterior.

Displacements often fix one combination of the elastic parameters sharply and leave the others
uncertain: the posterior is a thin, bent sheet, on which a sampler with one metric needs small
steps. In unconstrained coordinates :math:`z`, ordered from the least to the best determined, take

.. math:: z_k = \zeta_k + c_k \cdot \varphi(s(z_1), \dots, s(z_{k-1})), \qquad s = \text{sigmoid}

with :math:`\varphi` all monomials up to a degree. The map is triangular with unit diagonal, so its
Jacobian determinant is 1 and the density of :math:`\zeta` is that of :math:`z`: *any* coefficients
leave the posterior exact, and good ones remove its curvature. They are fitted to the draws of a
pilot run by least squares.

Chains run in :math:`w` with :math:`\zeta = m + s \odot w`, mean and standard deviation of the
straightened draws, so that the unit metric they begin with is about the right one. The constant
Jacobian of that is left out.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from math import comb
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit

_LEAST_SD = 1e-9


class TransportMap(NamedTuple):
    """A triangular map.

    order : the coordinates (p,), the least determined first.
    coefficients : the weights (p, features) of the monomials in each coordinate.
    """

    order: jax.Array
    coefficients: jax.Array


class StandardMap(NamedTuple):
    """The map from w (p,), of about zero mean and unit sd, to z.

    bend : the map from zeta to z. centre, scale : mean and sd (p,) of zeta.
    """

    bend: TransportMap
    centre: jax.Array
    scale: jax.Array


def _degree(count: int) -> int:
    return 3 if count <= 3 else 2


def monomials(values: Any, count: int) -> Any:
    """Return monomials (..., f) of the first ``count`` columns of ``values``, centred on 1/2."""
    centred = [values[..., k] - 0.5 for k in range(count)]
    terms = []
    for degree in range(1, _degree(count) + 1):
        for chosen in combinations_with_replacement(range(count), degree):
            product = centred[chosen[0]]
            for k in chosen[1:]:
                product = product * centred[k]
            terms.append(product)
    # NumPy arrays stay with NumPy: JAX would compile each operation.
    stack = np.stack if isinstance(values, np.ndarray) else jnp.stack
    return stack(terms, axis=-1)


def coefficient_count(dimension: int) -> int:
    """Return the largest number of coefficients of a coordinate."""
    counts = (comb(k + _degree(k), k) - 1 for k in range(1, dimension))
    return max(counts, default=0)


def apply(map_: TransportMap, zeta: jax.Array) -> jax.Array:
    """Return ``z`` (p,) from ``zeta`` (p,)."""
    if not map_.coefficients.size:
        return zeta
    ordered = zeta[map_.order]
    squashed = jax.nn.sigmoid(ordered)
    columns = [ordered[0]]
    for k in range(1, len(zeta)):
        terms = monomials(squashed, k)
        z = ordered[k] + map_.coefficients[k, : terms.size] @ terms
        squashed = squashed.at[k].set(jax.nn.sigmoid(z))
        columns.append(z)
    return jnp.stack(columns)[jnp.argsort(map_.order)]


def straighten(map_: TransportMap, z: np.ndarray) -> np.ndarray:
    """Return ``zeta`` (s, p) from ``z`` (s, p): the inverse of :func:`apply`.

    The map is triangular: each coordinate's shift depends on coordinates of ``z`` alone.
    """
    order, coefficients = np.asarray(map_.order), np.asarray(map_.coefficients)
    squashed = expit(z[:, order])
    zeta = np.array(z)
    for k in range(1, z.shape[1]):
        terms = monomials(squashed, k)
        zeta[:, order[k]] -= terms @ coefficients[k, : terms.shape[1]]
    return zeta


def bend(map_: TransportMap, zeta: np.ndarray) -> np.ndarray:
    """Return ``z`` (s, p) from ``zeta`` (s, p): :func:`apply` to many points, uncompiled."""
    order, coefficients = np.asarray(map_.order), np.asarray(map_.coefficients)
    z = np.array(zeta)
    squashed = expit(z[:, order])
    for k in range(1, z.shape[1]):
        terms = monomials(squashed, k)
        z[:, order[k]] += terms @ coefficients[k, : terms.shape[1]]
        squashed[:, k] = expit(z[:, order[k]])
    return z


def fit(draws: np.ndarray) -> TransportMap:
    """Return the map fitted to pilot draws (s, p) of ``z``."""
    dimension = draws.shape[1]
    squashed = expit(draws)
    order = np.argsort(-squashed.std(axis=0), kind="stable")
    coefficients = np.zeros((dimension, coefficient_count(dimension)))
    for k in range(1, dimension):
        terms = monomials(squashed[:, order], k)
        target = draws[:, order[k]]
        # Ridge penalty: features that a short pilot hardly varied get small coefficients.
        sd = np.maximum(terms.std(axis=0), 1e-12)
        ridge = 1e-3 * np.eye(terms.shape[1]) * len(terms) ** 0.5
        design = np.vstack([(terms - terms.mean(axis=0)) / sd, ridge])
        values = np.concatenate([target - target.mean(), np.zeros(terms.shape[1])])
        coefficients[k, : terms.shape[1]] = np.linalg.lstsq(design, values, rcond=None)[0] / sd
    return TransportMap(jnp.asarray(order), jnp.asarray(coefficients))


def standard_identity(dimension: int, *, bends: bool = True) -> StandardMap:
    """Return the identity map; without ``bends`` it has no coefficients at all."""
    coefficients = jnp.zeros((dimension, coefficient_count(dimension) if bends else 0))
    bend = TransportMap(jnp.arange(dimension), coefficients)
    return StandardMap(bend, jnp.zeros(dimension), jnp.ones(dimension))


def apply_standard(map_: StandardMap, w: jax.Array) -> jax.Array:
    """Return ``z`` (p,) from ``w`` (p,)."""
    return apply(map_.bend, map_.centre + map_.scale * w)


def fit_standard(draws: np.ndarray) -> StandardMap:
    """Return the map fitted to pilot draws (s, p) of ``z``."""
    bend = fit(draws)
    straight = straighten(bend, draws)
    sd = straight.std(axis=0)
    # A pilot whose chains did not move has no scale.
    scale = np.where(sd > _LEAST_SD, sd, 1.0)
    return StandardMap(bend, jnp.asarray(straight.mean(axis=0)), jnp.asarray(scale))
