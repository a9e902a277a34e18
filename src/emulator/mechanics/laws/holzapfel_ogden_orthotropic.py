r"""Holzapfel-Ogden material with fibres f and sheets s (orthotropic).

.. math::
    W = \frac{a}{2b}\left[e^{b(\bar I_1 - 3)} - 1\right]
      + \sum_{i = f, s}
        \frac{a_i}{2b_i}\left[e^{b_i \langle \bar I_{4i} - 1 \rangle^2} - 1\right]
      + \frac{a_{fs}}{2b_{fs}}\left[e^{b_{fs} \bar I_{8fs}^2} - 1\right] + U(J)

(Holzapfel & Ogden 2009, Eq. 5.38) with isochoric invariants, :math:`\bar I_{8fs} = J^{-2/3} f \cdot
C s`, and fibres and sheets that resist stretch only. Without its last two terms it is the law of
:mod:`~emulator.mechanics.laws.holzapfel_ogden`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import holzapfel_ogden
from emulator.mechanics.laws.law import Law, modulus, number


def energy(
    strain: Strain,
    a: jax.Array,
    b: jax.Array,
    a_f: jax.Array,
    b_f: jax.Array,
    a_s: jax.Array,
    b_s: jax.Array,
    a_fs: jax.Array,
    b_fs: jax.Array,
    kappa: jax.Array,
) -> jax.Array:
    """Return the strain energy density in kPa; all moduli and ``kappa`` are in kPa."""
    stretch = jnp.maximum(strain.isochoric_I4s_minus_1, 0.0)
    sheets = a_s / (2.0 * b_s) * jnp.expm1(b_s * stretch**2)
    shear = a_fs / (2.0 * b_fs) * jnp.expm1(b_fs * strain.isochoric_I8fs**2)
    return holzapfel_ogden.energy(strain, a, b, a_f, b_f, kappa) + sheets + shear


_EXPONENTIALS = [q for s in ("", "_f", "_s", "_fs") for q in (modulus("a" + s), number("b" + s))]
HOLZAPFEL_OGDEN_ORTHOTROPIC = Law(
    "holzapfel_ogden_orthotropic",
    (*_EXPONENTIALS, modulus("kappa")),
    energy,
    fibres=True,
    sheets=True,
    shape_moduli=("a", "a_f", "a_s", "a_fs"),
    exponential=True,
    simpler=(("sheets", holzapfel_ogden.HOLZAPFEL_OGDEN),),
)
LAWS = (HOLZAPFEL_OGDEN_ORTHOTROPIC,)
