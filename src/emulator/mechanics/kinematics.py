r"""Strain measures of one material point, from the displacement gradient.

With :math:`H = \partial u/\partial X` and :math:`F = I + H`,

.. math::
    J - 1 &= \operatorname{tr} H + \det H
        + \tfrac12\left[(\operatorname{tr} H)^2 - \operatorname{tr} H^2\right] \\
    I_1 - 3 &= 2 \operatorname{tr} H + H : H

Written in ``H``, small strains lose no digits to cancellation, which matters in float32. Nothing
here calls LAPACK: 3x3 determinants are triple products.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from emulator.mechanics.barriers import Barriers


def determinant(A: jax.Array) -> jax.Array:
    """Determinant of one 3x3 matrix by the triple product of its rows, shape ()."""
    return jnp.dot(A[0], jnp.cross(A[1], A[2]))


@dataclass(frozen=True)
class Strain:
    """What a hyperelastic law may ask of one material point; each measure is computed on demand.

    Parameters
    ----------
    H : (3, 3) displacement gradient, dimensionless.
    barriers : limits on the invariants, for training only. ``None`` leaves them exact.
    """

    H: jax.Array
    barriers: Barriers | None = None

    @property
    def J_minus_1(self) -> jax.Array:
        """Relative volume change ``det F - 1``, shape ()."""
        trace = jnp.trace(self.H)
        second = 0.5 * (trace**2 - jnp.sum(self.H * self.H.T))
        change = trace + second + determinant(self.H)
        return change if self.barriers is None else self.barriers.limit_J(1.0 + change) - 1.0

    @property
    def ln_J(self) -> jax.Array:
        """Logarithmic volume change, NaN where the material point is inverted."""
        return jnp.log1p(self.J_minus_1)

    @property
    def I1_minus_3(self) -> jax.Array:
        """First invariant of ``C = F^T F`` less its value at rest, shape ()."""
        change = 2.0 * jnp.trace(self.H) + jnp.sum(self.H * self.H)
        return change if self.barriers is None else self.barriers.limit_I1(3.0 + change) - 3.0
