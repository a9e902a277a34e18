r"""A transport map: the change of variables that straightens curved ridges of the posterior.

Displacements often fix one combination of the elastic parameters sharply and leave the others
uncertain: the posterior is a thin, bent sheet, on which a sampler with one metric needs small
steps. In unconstrained coordinates :math:`z`, ordered from the least to the best determined, take

.. math:: z_k = \zeta_k + c_k \cdot \varphi(s(z_1), \dots, s(z_{k-1})), \qquad s = \text{sigmoid}

with :math:`\varphi` all monomials of :math:`s - 1/2` up to degree 2, or 3 of three or fewer. The
map is triangular with unit diagonal, so its Jacobian determinant is 1 and the density of
:math:`\zeta` is that of :math:`z`: *any* coefficients leave the posterior exact, and good ones
remove its curvature. They are fitted to the draws of a pilot run by least squares.

Chains run in :math:`w` with :math:`\zeta = m + R\, w`, the mean and the standard deviations of the
straightened draws, so that the unit metric they begin with is about the right one. The constant
Jacobian of that is left out. Of many coordinates a pilot run cannot tell the bends: there m is a
mode, and :math:`R R^T` the inverse of the curvature.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit

_LEAST_SD = 1e-9
_CUBIC = 3  # coordinates, counted from 1, up to which a shift has monomials of degree 3


class TransportMap(NamedTuple):
    """A triangular map.

    order : the coordinates (p,), the least determined first.
    coefficients : the weights (p, f) of the monomials in each coordinate, 0 of later ones.
    """

    order: jax.Array
    coefficients: jax.Array


class StandardMap(NamedTuple):
    """The map from w (p,), of about zero mean and unit sd, to z.

    bend : the map from zeta to z. centre, root : m (p,) and R (p, p).
    """

    bend: TransportMap
    centre: jax.Array
    root: jax.Array


class _Features(NamedTuple):
    """The monomials of all coordinates: the coordinates that each multiplies.

    pairs : (2, f2) coordinates of those of degree 2. triples : (3, f3) of the first three ones.
    """

    pairs: np.ndarray
    triples: np.ndarray

    def of(self, centred: Any) -> Any:
        """Return the monomials (..., f), by degree, of values (..., p)."""
        products = [centred]
        for factors in self:
            terms = centred[..., factors[0]]
            for k in factors[1:]:
                terms = terms * centred[..., k]
            products.append(terms)
        # NumPy arrays stay with NumPy: JAX would compile each operation.
        xp = np if isinstance(centred, np.ndarray) else jnp
        return xp.concatenate(products, axis=-1)

    def used(self, dimension: int, k: int) -> np.ndarray:
        """Return whether coordinate k has each monomial: of those before it, (f,) bool."""
        cubic = (self.triples < k).all(axis=0) if k <= _CUBIC else np.zeros(self.triples.shape[1])
        return np.concatenate(
            [np.arange(dimension) < k, (self.pairs < k).all(axis=0), cubic.astype(bool)]
        )


@lru_cache(maxsize=64)
def _features(dimension: int) -> _Features:
    few = range(min(_CUBIC, dimension))
    triples = np.array(list(combinations_with_replacement(few, 3)), dtype=int)
    return _Features(np.array(np.triu_indices(dimension)), triples.reshape(-1, 3).T)


def coefficient_count(dimension: int) -> int:
    """Return the largest number of coefficients of a coordinate."""
    features = _features(dimension)
    return max((int(features.used(dimension, k).sum()) for k in range(1, dimension)), default=0)


def apply(map_: TransportMap, zeta: jax.Array) -> jax.Array:
    """Return ``z`` (p,) from ``zeta`` (p,)."""
    if not map_.coefficients.size:
        return zeta
    features = _features(len(zeta))

    def step(centred: jax.Array, row: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        # Coordinates that are not known yet are 0, and so are their monomials.
        k, value, coefficients = row
        z = value + coefficients @ features.of(centred)
        return centred.at[k].set(jax.nn.sigmoid(z) - 0.5), z

    rows = (jnp.arange(len(zeta)), zeta[map_.order], map_.coefficients)
    _, z = jax.lax.scan(step, jnp.zeros_like(zeta), rows)
    return z[jnp.argsort(map_.order)]


def straighten(map_: TransportMap, z: np.ndarray) -> np.ndarray:
    """Return ``zeta`` (s, p) from ``z`` (s, p): the inverse of :func:`apply`.

    The map is triangular: each coordinate's shift depends on coordinates of ``z`` alone.
    """
    order, coefficients = np.asarray(map_.order), np.asarray(map_.coefficients)
    zeta = np.array(z)
    if coefficients.size:
        zeta[:, order] -= _features(z.shape[1]).of(expit(z[:, order]) - 0.5) @ coefficients.T
    return zeta


def bend(map_: TransportMap, zeta: np.ndarray) -> np.ndarray:
    """Return ``z`` (s, p) from ``zeta`` (s, p): :func:`apply` to many points, uncompiled."""
    order, coefficients = np.asarray(map_.order), np.asarray(map_.coefficients)
    z, features = np.array(zeta), _features(zeta.shape[1])
    centred = np.zeros_like(z)
    for k in range(z.shape[1] if coefficients.size else 0):
        z[:, order[k]] += features.of(centred) @ coefficients[k]
        centred[:, k] = expit(z[:, order[k]]) - 0.5
    return z


def fit(draws: np.ndarray) -> TransportMap:
    """Return the map fitted to pilot draws (s, p) of ``z``."""
    dimension = draws.shape[1]
    squashed = expit(draws)
    order = np.argsort(-squashed.std(axis=0), kind="stable")
    features = _features(dimension)
    every = features.of(squashed[:, order] - 0.5)
    coefficients = np.zeros((dimension, every.shape[1]))
    for k in range(1, dimension):
        used = features.used(dimension, k)
        terms, target = every[:, used], draws[:, order[k]]
        # Ridge penalty: features that a short pilot hardly varied get small coefficients.
        sd = np.maximum(terms.std(axis=0), 1e-12)
        ridge = 1e-3 * np.eye(terms.shape[1]) * len(terms) ** 0.5
        design = np.vstack([(terms - terms.mean(axis=0)) / sd, ridge])
        values = np.concatenate([target - target.mean(), np.zeros(terms.shape[1])])
        coefficients[k, used] = np.linalg.lstsq(design, values, rcond=None)[0] / sd
    return TransportMap(jnp.asarray(order), jnp.asarray(coefficients))


def standard_identity(dimension: int, *, bends: bool = True) -> StandardMap:
    """Return the identity map; without ``bends`` it has no coefficients at all."""
    count = _features(dimension).used(dimension, dimension).size if bends else 0
    coefficients = jnp.zeros((dimension, count))
    bend = TransportMap(jnp.arange(dimension), coefficients)
    return StandardMap(bend, jnp.zeros(dimension), jnp.eye(dimension))


def apply_standard(map_: StandardMap, w: jax.Array) -> jax.Array:
    """Return ``z`` (p,) from ``w`` (p,)."""
    return apply(map_.bend, map_.centre + map_.root @ w)


def fit_standard(draws: np.ndarray) -> StandardMap:
    """Return the map fitted to pilot draws (s, p) of ``z``."""
    bend = fit(draws)
    straight = straighten(bend, draws)
    sd = straight.std(axis=0)
    # A pilot whose chains did not move has no scale.
    scale = np.where(sd > _LEAST_SD, sd, 1.0)
    return StandardMap(bend, jnp.asarray(straight.mean(axis=0)), jnp.diag(jnp.asarray(scale)))
