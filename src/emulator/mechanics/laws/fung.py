r"""Fung materials: one exponential of the Green-Lagrange strain in the axes f, s, n of the tissue.

.. math::
    W = \frac{C}{2} \left(e^{Q} - 1\right) + \frac{\mu}{2} (\bar I_1 - 3)
        + \frac{\kappa}{4} (J^2 - 1 - 2 \ln J)

with, for a material with three axes,

.. math::
    Q = b_1 E_{ff}^2 + b_2 E_{ss}^2 + b_3 E_{nn}^2
      + 2 b_4 E_{ff} E_{ss} + 2 b_5 E_{ss} E_{nn} + 2 b_6 E_{nn} E_{ff}
      + 4 b_7 E_{fs}^2 + 4 b_8 E_{sn}^2 + 4 b_9 E_{nf}^2

(Chuong & Fung 1986; Humphrey 1995), and in the plane of a sheet (Tong & Fung 1976)

.. math:: Q = b_1 E_{ff}^2 + b_2 E_{ss}^2 + 2 b_4 E_{ff} E_{ss} + 4 b_7 E_{fs}^2 .

C, :math:`\mu` and :math:`\kappa` are in kPa. A membrane needs no matrix (:math:`\mu`, which may be
0); a body does, because the planar exponential resists nothing across its plane. The exponential is
convex in E where its quadratic form is positive definite, for which :math:`b_4^2 < b_1 b_2` in the
plane; the energy is not polyconvex.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law, Quantity, modulus, number, quadratic_logarithmic


def energy_planar(
    strain: Strain, C: jax.Array, b_1: jax.Array, b_2: jax.Array, b_4: jax.Array, b_7: jax.Array,
    mu: jax.Array, kappa: jax.Array,
) -> jax.Array:  # fmt: skip
    """Return the planar strain energy density in kPa; C, mu and kappa in kPa."""
    E, f, s = strain.green_lagrange, strain.fibre, strain.sheet
    ff, ss, fs = f @ E @ f, s @ E @ s, f @ E @ s
    Q = b_1 * ff**2 + b_2 * ss**2 + 2.0 * b_4 * ff * ss + 4.0 * b_7 * fs**2
    return _energy(strain, C, Q, mu, kappa)


def energy(
    strain: Strain, C: jax.Array, b_1: jax.Array, b_2: jax.Array, b_3: jax.Array, b_4: jax.Array,
    b_5: jax.Array, b_6: jax.Array, b_7: jax.Array, b_8: jax.Array, b_9: jax.Array,
    mu: jax.Array, kappa: jax.Array,
) -> jax.Array:  # fmt: skip
    """Return the orthotropic strain energy density in kPa; C, mu and kappa in kPa."""
    axes = jnp.stack([strain.fibre, strain.sheet, jnp.cross(strain.fibre, strain.sheet)])
    E = axes @ strain.green_lagrange @ axes.T
    Q = (
        b_1 * E[0, 0] ** 2
        + b_2 * E[1, 1] ** 2
        + b_3 * E[2, 2] ** 2
        + 2.0 * (b_4 * E[0, 0] * E[1, 1] + b_5 * E[1, 1] * E[2, 2] + b_6 * E[2, 2] * E[0, 0])
        + 4.0 * (b_7 * E[0, 1] ** 2 + b_8 * E[1, 2] ** 2 + b_9 * E[2, 0] ** 2)
    )
    return _energy(strain, C, Q, mu, kappa)


def _energy(
    strain: Strain, C: jax.Array, Q: jax.Array, mu: jax.Array, kappa: jax.Array
) -> jax.Array:
    matrix = 0.5 * mu * strain.isochoric_I1_minus_3
    return 0.5 * C * jnp.expm1(Q) + matrix + quadratic_logarithmic(strain, 0.25 * kappa)


_C, _MATRIX = modulus("C"), (Quantity("mu", "kPa", low_admitted=True), modulus("kappa"))
_COUPLING = {k: Quantity(f"b_{k}", "", -math.inf) for k in (4, 5, 6)}


def _law(name: str, *numbers: int) -> Law:
    b = (_COUPLING.get(k) or number(f"b_{k}") for k in numbers)
    function = energy if len(numbers) == 9 else energy_planar
    return Law(
        name,
        (_C, *b, *_MATRIX),
        function,
        fibres=True,
        sheets=True,
        shape_moduli=("C", "mu"),
        exponential=True,
    )


FUNG_PLANAR = _law("fung_planar", 1, 2, 4, 7)
FUNG_ORTHOTROPIC = _law("fung_orthotropic", *range(1, 10))
LAWS = (FUNG_PLANAR, FUNG_ORTHOTROPIC)
