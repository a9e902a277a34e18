r"""Coordinates of members in which a population is easy to sample.

Given the population, :math:`x_i = x(q_i)` (``cut_normal``) with scores :math:`q_i = L z_i`. A
member whose data says nothing wants :math:`z_i` as its coordinates, one whose data fixes
:math:`x_i` wants :math:`x_i`: in the others the posterior is a funnel, or a thin sheet. Take the
member's log likelihood for quadratic around a value :math:`\bar x_i`, with slope :math:`g_i` and
precision :math:`\Lambda_i`, and :math:`x(q)` for linear around the score :math:`\bar q_i` of
:math:`\bar x_i`, with slopes :math:`D = \text{diag}(dx_k/dq_k)`. Then :math:`z_i` given the
population is Gaussian, and in

.. math:: z_i = P^{-1} L^T D\,(g_i + \Lambda_i D \bar q_i) + C^{-T} e_i, \qquad
          P = I + L^T D \Lambda_i D L = C C^T

:math:`e_i` is standard normal and independent of the population. The change of variables has the
determinant :math:`\prod_k C_{kk}^{-1}` and is exact for *any* :math:`\bar x_i`, :math:`g_i` and
:math:`\Lambda_i`; good ones make the posterior round. They come from the member's own posterior, by
taking its prior off (both as Gaussians),

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

from calibrate.population.cut_normal import to_score


class Information(NamedTuple):
    """What each member's data says of its shared unknowns, near a value, on their scales.

    value : (n, k). slope : (n, k) of the log likelihood there. precision : (n, k, k).
    """

    value: jax.Array
    slope: jax.Array
    precision: jax.Array


class Cut(NamedTuple):
    """A population on the parameters' scales: mean, sd, low and high end (k,), factor L (k, k)."""

    mean: jax.Array
    sd: jax.Array
    low: jax.Array
    high: jax.Array
    factor: jax.Array


def information_of(draws: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, ...]:
    """Value (k,), slope (k,) and precision (k, k) from draws (s, k), and the prior's."""
    root = np.linalg.cholesky(np.atleast_2d(np.cov(prior.T)))
    whitened = np.linalg.solve(root, (draws - prior.mean(axis=0)).T)
    sizes, axes = np.linalg.eigh(np.atleast_2d(np.cov(whitened)))
    # Directions in which draws happen to spread more than the prior are left out.
    gained = np.maximum(1.0 / np.maximum(sizes, 1e-12) - 1.0, 0.0)
    moved = np.where(gained > 0.0, axes.T @ whitened.mean(axis=1), 0.0)
    back = np.linalg.solve(root.T, axes)
    return draws.mean(axis=0), back @ moved, (back * gained) @ back.T


def scores_of(
    e: jax.Array, information: Information, population: Cut
) -> tuple[jax.Array, jax.Array]:
    """Scores z (n, k) at coordinates ``e`` (n, k), and the log of the determinant dz/de, ()."""
    z, heights = jax.vmap(_of_one, in_axes=(0, 0, None))(e, information, population)
    return z, jnp.sum(heights)


def _of_one(e: jax.Array, information: Information, population: Cut) -> tuple[jax.Array, jax.Array]:
    *cut, factor = population
    score, slope = to_score(information.value, *cut)
    root = slope[:, None] * factor
    C = _cholesky(jnp.eye(len(e)) + root.T @ information.precision @ root)
    pull = information.slope + information.precision @ (slope * score)
    z = _substitute_back(C, _substitute(C, root.T @ pull) + e)
    return z, -sum((jnp.log(C[k][k]) for k in range(len(e))), jnp.zeros(()))


# LAPACK on batches of small matrices can hang, so these are written out; count is 1 to 10.


def _cholesky(matrix: jax.Array) -> list[list[jax.Array]]:
    """Rows of the lower factor of a positive definite matrix (k, k)."""
    rows: list[list[jax.Array]] = []
    for i in range(len(matrix)):
        row: list[jax.Array] = []
        for j in range(i):
            rest = sum((row[k] * rows[j][k] for k in range(j)), jnp.zeros(()))
            row.append((matrix[i, j] - rest) / rows[j][j])
        row.append(jnp.sqrt(matrix[i, i] - sum((r * r for r in row), jnp.zeros(()))))
        rows.append(row)
    return rows


def _substitute(C: list[list[jax.Array]], b: jax.Array) -> jax.Array:
    """``C^-1 b`` (k,) of the lower factor C."""
    found: list[jax.Array] = []
    for i, row in enumerate(C):
        rest = sum((row[j] * found[j] for j in range(i)), jnp.zeros(()))
        found.append((b[i] - rest) / row[i])
    return jnp.stack(found)


def _substitute_back(C: list[list[jax.Array]], b: jax.Array) -> jax.Array:
    """``C^-T b`` (k,) of the lower factor C."""
    found: dict[int, jax.Array] = {}
    for i in reversed(range(len(C))):
        rest = sum((C[j][i] * found[j] for j in range(i + 1, len(C))), jnp.zeros(()))
        found[i] = (b[i] - rest) / C[i][i]
    return jnp.stack([found[i] for i in range(len(C))])
