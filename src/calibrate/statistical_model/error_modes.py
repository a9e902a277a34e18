r"""Errors of the data as a whole, as a few modes: they correlate numbers of all observations.

.. math:: y = g(x) + V q + \varepsilon, \qquad q \sim N(0, \alpha(x)^2 I)

with the modes V in the units of the data. The q are marginalised in closed form. With the noise's
information W, :math:`G = V^T W V`, made diagonal by the choice of V, and
:math:`b = V^T W\,(y - g)`, they change the log likelihood of the residual by

.. math:: \tfrac12 \sum_i \left[\frac{\alpha^2 b_i^2}{1 + \alpha^2 G_{ii}}
          - \log\left(1 + \alpha^2 G_{ii}\right)\right]

(matrix determinant lemma and Woodbury's identity), and given the data

.. math:: q_i \mid y, x \sim
          N\left(\frac{\alpha^2 b_i}{1 + \alpha^2 G_{ii}},\;
                 \frac{\alpha^2}{1 + \alpha^2 G_{ii}}\right),

and leave of the information about the means

.. math:: W - W V \left(\alpha^{-2} I + G\right)^{-1} V^T W .
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree

from emulator.surrogates.protocol import fingerprint_of

Means = Mapping[str, jax.Array]
"""Data without noise by the observation's name."""


@dataclass(frozen=True, eq=False)
class ErrorModes(ABC):
    """Errors of all data, marginalised.

    weights : (r, d), :math:`V^T W`: residual of all data to b.
    strength : (r,), the diagonal of G.
    modes : (r, d), :math:`V^T`, for replicated data.
    """

    weights: np.ndarray
    strength: np.ndarray
    modes: np.ndarray

    def size(self, unknowns: jax.Array) -> jax.Array:
        r"""The size :math:`\alpha`, (), at ``unknowns``: theta's (q,), then those of ``priors``."""
        del unknowns
        return jnp.ones(())

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Of its own unknown numbers, by their names in the posterior."""
        return {}

    def largest(self, means: Means) -> np.ndarray:
        """Modes (r, d) at their largest plausible size, beside data like ``means``."""
        del means
        return self.modes

    def log_ratio(self, unknowns: jax.Array, residual: Means, means: Means) -> jax.Array:
        """What the error adds to the log likelihood of ``residual``, data less ``means``."""
        del means
        flat, _ = ravel_pytree(dict(residual))
        variance = self.size(unknowns) ** 2
        b, inflated = self.weights @ flat, 1.0 + variance * self.strength
        return 0.5 * jnp.sum(variance * b**2 / inflated - jnp.log(inflated))

    def information_left(
        self, information: jax.Array, unknowns: jax.Array, means: Means
    ) -> jax.Array:
        """What is left of the noise's ``information`` (d, d) about ``means`` at ``unknowns``."""
        del means
        variance = self.size(unknowns) ** 2
        share = variance / (1.0 + variance * self.strength)
        return information - (self.weights.T * share) @ self.weights

    @property
    @abstractmethod
    def of_fem(self) -> bool:
        """Whether data differs from FEM on the map's mesh by them, too."""

    @property
    @abstractmethod
    def with_mesh(self) -> bool:
        """Whether the error of the mesh is among them."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """All it consists of, by name."""

    @property
    def fingerprint(self) -> str:
        """Short hash of all it consists of."""
        return fingerprint_of(*self.arrays().values())

    def draw(self, rng_key: jax.Array, unknowns: jax.Array, means: Means) -> dict[str, jax.Array]:
        """Data without noise as it might have come: ``means`` plus a draw of the error."""
        flat, unravel = ravel_pytree(dict(means))
        coefficients = jax.random.normal(rng_key, self.strength.shape)
        return unravel(flat + self.size(unknowns) * (coefficients @ self.modes))


def diagonal(modes: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, ...]:
    """Modes (r, d) of the same covariance whose G is diagonal: weights, strength, modes, mixing.

    ``mixing`` (r, s) makes them of the given ``modes`` (s, d): an orthogonal matrix, less rows for
    what cannot be told from nothing. ``information`` (d, d) of the noise.
    """
    strength, mixing = np.linalg.eigh(modes @ information @ modes.T)
    kept = strength > 1e-12 * max(float(strength.max(initial=0.0)), 1e-300)
    rows = mixing[:, kept].T
    mixed = rows @ modes
    return mixed @ information, strength[kept], mixed, rows
