r"""A sum of terms in the invariants, each with a modulus of its own.

.. math::
    W = \sum_k c_k\, w_k + \frac{\kappa}{4} (J^2 - 1 - 2 \ln J), \qquad c_k \ge 0

with :math:`x = \bar I_1 - 3`, :math:`y = \bar I_2 - 3`, :math:`f = \langle \bar I_{4f} - 1\rangle`,
:math:`s = \langle \bar I_{4s} - 1\rangle`, :math:`g = \bar I_{8fs}` and

=========  ================================  =========  ================================
modulus    term                              modulus    term
=========  ================================  =========  ================================
``I1``     :math:`x/2`                       ``f_3``    :math:`f^3/3`
``I1_2``   :math:`x^2/2`                     ``f_e``    :math:`(e^{20 f^2} - 1)/40`
``I1_e``   :math:`(e^{10 x} - 1)/20`         ``s_2``    :math:`s^2/2`
``I2``     :math:`y/2`                       ``s_e``    :math:`(e^{20 s^2} - 1)/40`
``I2_2``   :math:`y^2/2`                     ``fs_2``   :math:`g^2/2`
``f_2``    :math:`f^2/2`                     ``fs_e``   :math:`(e^{20 g^2} - 1)/40`
=========  ================================  =========  ================================

The energy is linear in all moduli, so that which of them are zero can be decided exactly
(:mod:`calibrate.analysis.terms`). Terms are of the kind that constitutive networks choose from
(Linka and Kuhl 2023, Comput. Methods Appl. Mech. Eng. 403:115731), with fixed exponents. Fibres and
sheets resist extension only, and each term is convex in its
invariant.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.holzapfel_ogden import energy_of_fibres
from emulator.mechanics.laws.law import Law, Quantity, modulus, quadratic_logarithmic

_B, _B_FIBRES = 10.0, 20.0
TERMS = (
    "I1", "I1_2", "I1_e", "I2", "I2_2", "f_2", "f_3", "f_e", "s_2", "s_e", "fs_2", "fs_e",
)  # fmt: skip
"""The moduli of the terms."""


def energy(strain: Strain, *parameters: jax.Array) -> jax.Array:
    """Return the strain energy density in kPa; moduli of :data:`TERMS` and kappa in kPa."""
    *moduli, kappa = parameters
    x, y = strain.isochoric_I1_minus_3, strain.isochoric_I2_minus_3
    f = jnp.maximum(strain.isochoric_I4f_minus_1, 0.0)
    s = jnp.maximum(strain.isochoric_I4s_minus_1, 0.0)
    g = strain.isochoric_I8fs
    one, steep = jnp.ones(()), jnp.asarray(_B_FIBRES)
    terms = (
        0.5 * x, 0.5 * x**2, 0.5 / _B * jnp.expm1(_B * x), 0.5 * y, 0.5 * y**2,
        0.5 * f**2, f**3 / 3.0, energy_of_fibres(f, one, steep),
        0.5 * s**2, energy_of_fibres(s, one, steep),
        0.5 * g**2, energy_of_fibres(g, one, steep),
    )  # fmt: skip
    total = sum((c * w for c, w in zip(moduli, terms, strict=True)), jnp.zeros(()))
    return total + quadratic_logarithmic(strain, 0.25 * kappa)


INVARIANT_TERMS = Law(
    "invariant_terms",
    (*(Quantity(name, "kPa", low_admitted=True) for name in TERMS), modulus("kappa")),
    energy,
    fibres=True,
    sheets=True,
    shape_moduli=TERMS,
    exponential=True,
)
LAWS = (INVARIANT_TERMS,)
