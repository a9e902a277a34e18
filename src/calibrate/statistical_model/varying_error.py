r"""Errors that many numbers share and that vary with what is unknown: by size, or as predictions.

.. math:: y = g(x) + V(x)\, q + \varepsilon, \qquad q \sim N(0, I), \qquad
          V_i(x) = \alpha_i\, (A_i + B_i \circ g(x)),

with modes A in the unit of the data, modes B that are shares of what is predicted (a load cell's
gain, what a law is off by along a curve), and a size :math:`\alpha_i` that is 1 or inferred, under
a half-normal prior. Shares are of the prediction g and not of the data: the noise of the data would
be scaled in the modes, too, so that smaller predictions would err less, and a scale of n numbers
would be fitted too low by the factor :math:`1 + (n - 1) s^2` (Peelle's puzzle; D'Agostini 1994).

The q are marginalised. With the information W of the noise and of errors before these,
:math:`G = V^T W V` and :math:`b = V^T W (y - g)`, the log likelihood of the residual changes by

.. math:: \tfrac12 b^T (I + G)^{-1} b - \tfrac12 \log |I + G|,

and of the information about the means :math:`W - W V (I + G)^{-1} V^T W` is left: that of the
errors' covariance where it is, not of what the covariance itself says of x. Both are sums over the
pivots of elimination (:func:`eliminated`), which is plain arithmetic: batched factorisations of
small matrices may hang.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree

from calibrate.statistical_model.error_modes import Means

_PLAUSIBLE = 3.0  # scales of a half-normal: its 99.7 % quantile


@dataclass(frozen=True, eq=False)
class VaryingError:
    """Systematic errors after those whose modes are known numbers.

    modes, shares : (r, d), A and B.
    sized : (r,) 1 where the size is inferred, 0 where it is 1.
    information : (d,) or (d, d), W.
    name, scale : of the size in the posterior, and of its half-normal prior; empty and 0 of none.
    """

    modes: np.ndarray
    shares: np.ndarray
    sized: np.ndarray
    information: np.ndarray
    name: str = ""
    scale: float = 0.0

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Half-normal, of the size that is inferred."""
        return {self.name: dist.HalfNormal(self.scale)} if self.name else {}

    def largest(self, means: Means) -> np.ndarray:
        """Modes (r, d) beside data like ``means``, at the 99.7 % quantile of the size's prior."""
        return np.asarray(self._modes(_PLAUSIBLE * self.scale, ravel_pytree(dict(means))[0]))

    def log_ratio(self, unknowns: jax.Array, residual: Means, means: Means) -> jax.Array:
        """What the errors add to the log likelihood of ``residual``, data less ``means``."""
        V, weights = self._at(unknowns, means)
        b = weights @ ravel_pytree(dict(residual))[0]
        pivots, rows = eliminated(weights @ V.T + jnp.eye(len(V)), b[:, None])
        return 0.5 * jnp.sum(rows[:, 0] ** 2 / pivots - jnp.log(pivots))

    def information_left(
        self, information: jax.Array, unknowns: jax.Array, means: Means
    ) -> jax.Array:
        """What is left of ``information`` (d, d), which is W, about the means at ``unknowns``."""
        V, weights = self._at(unknowns, means)
        pivots, rows = eliminated(weights @ V.T + jnp.eye(len(V)), weights)
        return information - (rows.T / pivots) @ rows

    def draw(self, rng_key: jax.Array, unknowns: jax.Array, means: Means) -> dict[str, jax.Array]:
        """``means`` plus a draw of the errors."""
        flat, unravel = ravel_pytree(dict(means))
        V, _ = self._at(unknowns, means)
        return unravel(flat + jax.random.normal(rng_key, (len(V),)) @ V)

    def arrays(self) -> dict[str, np.ndarray]:
        """All that changes a likelihood, by name."""
        names = ("modes", "shares", "sized", "information", "scale")
        return {name: np.asarray(getattr(self, name)) for name in names}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], name: str | None) -> VaryingError:
        """The errors of these :meth:`arrays`."""
        numbers: dict[str, Any] = {**arrays, "scale": float(arrays["scale"])}
        return cls(**numbers, name=name or "")

    def _modes(self, size: jax.Array | float, flat: jax.Array) -> jax.Array:
        alpha = jnp.where(self.sized > 0.0, size, 1.0)
        return alpha[:, None] * (self.modes + self.shares * flat)

    def _at(self, unknowns: jax.Array, means: Means) -> tuple[jax.Array, jax.Array]:
        """V^T (r, d) and V^T W."""
        size = unknowns[-1] if self.name else 1.0
        V = self._modes(size, ravel_pytree(dict(means))[0])
        of_each = self.information.ndim == np.ndim(V) - 1
        return V, V * self.information if of_each else V @ self.information


jax.tree_util.register_dataclass(
    VaryingError, ["modes", "shares", "sized", "information"], ["name", "scale"]
)


def eliminated(matrix: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
    r"""Pivots (r,) and reduced ``rows`` (r, m) of a positive definite ``matrix`` (r, r).

    Gauss without exchanges: :math:`|M| = \prod_k p_k`, and
    :math:`R^T M^{-1} R = \sum_k \rho_k \rho_k^T / p_k` with :math:`\rho_k` row k when it is the
    pivot's.
    """
    count = len(matrix)
    later = jnp.arange(count)

    def step(
        state: tuple[jax.Array, jax.Array], k: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        M, R = state
        pivot, row = M[k, k], R[k]
        factor = jnp.where(later > k, M[:, k] / pivot, 0.0)
        return (M - factor[:, None] * M[k], R - factor[:, None] * row), (pivot, row)

    found: tuple[jax.Array, jax.Array] = jax.lax.scan(step, (matrix, rows), later)[1]
    return found
