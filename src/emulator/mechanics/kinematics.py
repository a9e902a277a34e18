r"""Strain measures of one material point, from the displacement gradient.

With :math:`H = \partial u/\partial X` and :math:`F = I + H`,

.. math::
    J - 1 &= \operatorname{tr} H + \det H
        + \tfrac12\left[(\operatorname{tr} H)^2 - \operatorname{tr} H^2\right] \\
    I_1 - 3 &= 2 \operatorname{tr} H + H : H

Written in ``H``, small strains lose no digits to cancellation, which matters in float32. Nothing
here calls LAPACK: 3x3 determinants are triple products.

An untrained network predicts inverted and absurdly stretched elements. :class:`Barriers` keep the
training energy finite there (Dalton et al. 2023, Eq. 21-23). They replace :math:`J` below
``J_start`` by :math:`J_{min} + \exp(\beta_1 J + \beta_2)`, which is positive and meets :math:`J`
with equal value and slope; :math:`I_1` above ``I1_start`` by
:math:`I_1^* + \tanh(I_1 - I_1^*)`, which grows no further than ``I1_start + 1``; and
:math:`I_{4f}` above ``I4f_start`` likewise. Barriers belong to training: reported energies,
residuals and likelihoods use the exact invariants.
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
        """Return ``J``, below ``J_start`` a positive exponential tail (Eq. 21); shape kept."""
        width = self.J_start - self.J_min
        # Clipping keeps the unused branch of the where finite: its gradient is zero, not NaN.
        below = jnp.minimum(J, self.J_start)
        tail = self.J_min + width * jnp.exp((below - self.J_start) / width)
        return jnp.where(self.J_start < J, J, tail)

    def limit_I1(self, I1: jax.Array) -> jax.Array:
        """Return ``I1``, above ``I1_start`` a saturating tanh (Eq. 22); shape kept."""
        return _saturate(I1, self.I1_start)

    def limit_I4f(self, I4f: jax.Array) -> jax.Array:
        """Return ``I4f``, above ``I4f_start`` a saturating tanh (Eq. 23); shape kept."""
        return _saturate(I4f, self.I4f_start)


def _saturate(value: jax.Array, start: float) -> jax.Array:
    return jnp.where(value < start, value, start + jnp.tanh(value - start))


def determinant(A: jax.Array) -> jax.Array:
    """Return the determinant () of one 3x3 matrix by the triple product of its rows."""
    return jnp.dot(A[0], jnp.cross(A[1], A[2]))


@dataclass(frozen=True)
class Strain:
    """Strain measures of one material point, each computed on demand.

    Parameters
    ----------
    H : (3, 3) displacement gradient, dimensionless.
    barriers : limits on the invariants, for training only. ``None`` leaves them exact.
    directions : unit vectors in the reference body, for laws that read them: the fibre (3,), or
        the fibre and the sheet (2, 3).
    """

    H: jax.Array
    barriers: Barriers | None = None
    directions: jax.Array | None = None

    @property
    def fibre(self) -> jax.Array:
        """The fibre direction, (3,); present where the law declares ``fibres``."""
        if self.directions is None:
            raise TypeError("this point has no fibre")
        return self.directions if self.directions.ndim == 1 else self.directions[0]

    @property
    def sheet(self) -> jax.Array:
        """The sheet direction, (3,); present where the law declares ``sheets``."""
        if self.directions is None or self.directions.ndim == 1:
            raise TypeError("this point has no sheet")
        return self.directions[1]

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
        return self._limited_I1(2.0 * jnp.trace(self.H) + jnp.sum(self.H * self.H))

    @property
    def isochoric_I1_minus_3(self) -> jax.Array:
        """``J^(-2/3) I1 - 3``, independent of volume change, shape ()."""
        change = 2.0 * jnp.trace(self.H) + jnp.sum(self.H * self.H)
        power = -2.0 / 3.0 * self.ln_J
        return self._limited_I1(change * jnp.exp(power) + 3.0 * jnp.expm1(power))

    @property
    def isochoric_I2_minus_3(self) -> jax.Array:
        """``J^(-4/3) I2 - 3``, independent of volume change, shape ()."""
        change = 2.0 * self.green_lagrange
        trace, power = jnp.trace(change), -4.0 / 3.0 * self.ln_J
        change = 2.0 * trace + 0.5 * (trace**2 - jnp.sum(change * change))  # I2 - 3
        return self._limited_I1(change * jnp.exp(power) + 3.0 * jnp.expm1(power))

    @property
    def isochoric_I4f_minus_1(self) -> jax.Array:
        """``J^(-2/3) f . C f - 1``: squared fibre stretch less 1, volume change taken out, ()."""
        return self._isochoric_stretch(self.fibre)

    @property
    def isochoric_I4s_minus_1(self) -> jax.Array:
        """``J^(-2/3) s . C s - 1``: squared sheet stretch less 1, volume change taken out, ()."""
        return self._isochoric_stretch(self.sheet)

    @property
    def isochoric_I8fs(self) -> jax.Array:
        """``J^(-2/3) f . C s``: shear between fibre and sheet, shape ()."""
        f, s = self.fibre, self.sheet
        along_f, along_s = self.H @ f, self.H @ s
        shear = jnp.vdot(f, along_s) + jnp.vdot(along_f, s) + jnp.vdot(along_f, along_s)
        shear = shear * jnp.exp(-2.0 / 3.0 * self.ln_J)
        if self.barriers is None:
            return shear
        # No barrier is published for I8fs; the I4f barrier limits it for both signs.
        limit = self.barriers.limit_I4f
        return jnp.where(shear < 0.0, 1.0 - limit(1.0 - shear), limit(1.0 + shear) - 1.0)

    @property
    def small(self) -> jax.Array:
        """``(H + H^T)/2``, the strain of small displacements, shape (3, 3)."""
        return 0.5 * (self.H + self.H.T)

    @property
    def green_lagrange(self) -> jax.Array:
        """``E = (C - I)/2``, shape (3, 3)."""
        return 0.5 * (self.H + self.H.T + self.H.T @ self.H)

    def _isochoric_stretch(self, direction: jax.Array) -> jax.Array:
        along = self.H @ direction
        change = 2.0 * jnp.vdot(direction, along) + jnp.vdot(along, along)
        power = -2.0 / 3.0 * self.ln_J
        change = change * jnp.exp(power) + jnp.expm1(power)
        return change if self.barriers is None else self.barriers.limit_I4f(1.0 + change) - 1.0

    def _limited_I1(self, change: jax.Array) -> jax.Array:
        return change if self.barriers is None else self.barriers.limit_I1(3.0 + change) - 3.0


def cofactor(A: jax.Array) -> jax.Array:
    """Return the cofactor matrix ``det(A) A^-T`` of a 3x3 matrix by cross products of its rows."""
    return jnp.stack([jnp.cross(A[1], A[2]), jnp.cross(A[2], A[0]), jnp.cross(A[0], A[1])])
