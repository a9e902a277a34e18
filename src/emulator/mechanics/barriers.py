r"""Barriers that keep the training energy finite (Dalton et al. 2023, Eq. 21-23).

An untrained network predicts inverted and absurdly stretched elements. The barriers replace
:math:`J` below ``J_start`` by :math:`J_{min} + \exp(\beta_1 J + \beta_2)`, which is positive and
meets :math:`J` with equal value and slope (Eq. 21), and replace :math:`I_1` above ``I1_start`` by
:math:`I_1^* + \tanh(I_1 - I_1^*)`, which grows no further than ``I1_start + 1`` (Eq. 22), and
:math:`I_{4f}` above ``I4f_start`` likewise (Eq. 23).

They belong to training. Reported energies, residuals and likelihoods use the exact invariants.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp


@dataclass(frozen=True)
class Barriers:
    """Published values: the start of each barrier, and the lower limit ``J_min`` of ``J``."""

    J_min: float = 0.001
    J_start: float = 0.05
    I1_start: float = 10.0
    I4f_start: float = 8.0

    def limit_J(self, J: jax.Array) -> jax.Array:
        """``J`` above ``J_start``, below it a positive exponential tail (Eq. 21); shape kept."""
        width = self.J_start - self.J_min
        # Clipping keeps the unused branch of the where finite: its gradient is zero, not NaN.
        below = jnp.minimum(J, self.J_start)
        tail = self.J_min + width * jnp.exp((below - self.J_start) / width)
        return jnp.where(self.J_start < J, J, tail)

    def limit_I1(self, I1: jax.Array) -> jax.Array:
        """``I1`` below ``I1_start``, above it a saturating tanh (Eq. 22); shape kept."""
        return _saturate(I1, self.I1_start)

    def limit_I4f(self, I4f: jax.Array) -> jax.Array:
        """``I4f`` below ``I4f_start``, above it a saturating tanh (Eq. 23); shape kept."""
        return _saturate(I4f, self.I4f_start)


def _saturate(value: jax.Array, start: float) -> jax.Array:
    return jnp.where(value < start, value, start + jnp.tanh(value - start))
