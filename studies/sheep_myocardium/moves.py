r"""Moves between modes of a posterior, beside NUTS, which stays in one.

*Transport.* Modes are Gaussians :math:`N(\mu_i, L_i L_i^T)` with weights :math:`w_i`, as exploring
chains found them. At z one is taken to be in mode i with its responsibility :math:`p(i | z)`, goes
to mode j, drawn by the weights, and keeps its place in it,

.. math:: z' = \mu_j + L_j L_i^{-1} (z - \mu_i), \qquad
          \alpha = \min\Big(1, \frac{\pi(z')\, p(j | z')\, w_i\, |L_j|}
                                    {\pi(z)\, p(i | z)\, w_j\, |L_i|}\Big),

which balances each pair of modes in detail (the map from i to j is undone by that from j to i, and
its Jacobian is :math:`|L_j| / |L_i|`); wrong modes cost acceptance and nothing else.

*Mirror.* One of a cube's angles changes its sign: forces of a cube whose fibres are turned to one
side or the other are often nearly the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import logsumexp

EXPLORING = 4
"""Chains that seek modes, one each."""
MODES = 2 * EXPLORING
"""That transports go between: of two searches."""
_MOVES = 4  # of each kind a step of NUTS, which costs some thirty of them


class Modes(NamedTuple):
    """Gaussians of unconstrained positions: mean (m, d), factor (m, d, d), log_weight (m,)."""

    mean: jax.Array
    factor: jax.Array
    log_weight: jax.Array


def unknown(dimension: int) -> Modes:
    """Modes of which nothing is known: all the same, so that a transport moves nothing."""
    one = jnp.tile(jnp.eye(dimension), (MODES, 1, 1))
    return Modes(jnp.zeros((MODES, dimension)), one, jnp.zeros(MODES))


def modes(z: np.ndarray, log_density: np.ndarray) -> Modes:
    r"""A mode a chain: z (m, s, d) and their log densities (m, s).

    Weights are masses, :math:`\log w = E[\log \pi] + \log |L|` but for a constant: what a Gaussian
    posterior's is.
    """
    mean = z.mean(axis=1)
    floor = 1e-6 * np.eye(z.shape[2])
    factor = np.stack([np.linalg.cholesky(np.cov(each.T) + floor) for each in z])
    volume = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    mass = log_density.mean(axis=1) + volume
    # No mode is left for good: a chain that explored little knows its own mass badly.
    weight = np.maximum(mass - mass.max(), -3.0)
    return Modes(*(jnp.asarray(a) for a in (mean, factor, weight - logsumexp(weight))))


def joined(before: Modes | None, found: Modes) -> Modes:
    """Modes of the last of the searches ``before`` and of a new one, which count the same.

    Without an earlier one each of the new ones is there twice, which changes nothing.
    """
    older = found if before is None else Modes(*(part[-EXPLORING:] for part in before))
    weight = [part.log_weight - logsumexp(part.log_weight) for part in (older, found)]
    two = Modes(*(jnp.concatenate(pair) for pair in zip(older, found, strict=True)))
    return two._replace(log_weight=jnp.concatenate(weight) - jnp.log(2.0))


def _log_shares(modes: Modes, z: jax.Array) -> jax.Array:
    """Log responsibilities (m,) of modes for z (d,)."""

    def of(mean: jax.Array, factor: jax.Array) -> jax.Array:
        half = solve_triangular(factor, z - mean, lower=True)
        return -0.5 * jnp.vdot(half, half) - jnp.sum(jnp.log(jnp.diag(factor)))

    return jax.nn.log_softmax(modes.log_weight + jax.vmap(of)(modes.mean, modes.factor))


def transported(
    modes: Modes, z: jax.Array, i: jax.Array, j: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Where z (d,) in mode i is in mode j, and the logarithm of all but pi in alpha's ratio."""
    place = solve_triangular(modes.factor[i], z - modes.mean[i], lower=True)
    there = modes.mean[j] + modes.factor[j] @ place
    volumes = jnp.sum(jnp.log(jnp.diagonal(modes.factor, axis1=1, axis2=2)), axis=1)
    forth = _log_shares(modes, z)[i] + modes.log_weight[j] - volumes[j]
    back = _log_shares(modes, there)[j] + modes.log_weight[i] - volumes[i]
    return there, back - forth


def moved(
    potential: Callable[[jax.Array], jax.Array],
    given: Modes,
    mirrored: np.ndarray,
    at: tuple[jax.Array, jax.Array],
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Position (d,) and potential () after some transports and mirrors of ``at``, such a pair.

    potential : minus the log density of a position (d,). mirrored : (d,) whether an entry may
    change its sign.
    """

    def decided(
        key: jax.Array, at: tuple[jax.Array, jax.Array], there: jax.Array, more: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        z, before = at
        after = potential(there)
        taken = jnp.log(jax.random.uniform(key)) < before - after + more  # false for NaN
        return jnp.where(taken, there, z), jnp.where(taken, after, before)

    def move(
        at: tuple[jax.Array, jax.Array], key: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        first, second, third, fourth, fifth = jax.random.split(key, 5)
        i = jax.random.categorical(first, _log_shares(given, at[0]))
        j = jax.random.categorical(second, given.log_weight)
        at = decided(third, at, *transported(given, at[0], i, j))
        if mirrored.any():
            entry = jax.random.choice(fourth, np.flatnonzero(mirrored))
            at = decided(fifth, at, at[0].at[entry].multiply(-1.0), jnp.zeros(()))
        return at, None

    found: tuple[jax.Array, jax.Array] = jax.lax.scan(move, at, jax.random.split(key, _MOVES))[0]
    return found
