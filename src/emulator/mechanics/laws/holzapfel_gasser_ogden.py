r"""Arterial walls: two families of fibres, parallel (2000) or dispersed (2006).

.. math::
    W = \frac{c}{2} (\bar I_1 - 3)
      + \sum_{i = 4, 6} \frac{k_1}{2 k_2}\left[e^{k_2 \langle \bar E_i \rangle^2} - 1\right]
      + \frac{\kappa}{4} (J^2 - 1 - 2 \ln J), \qquad
    \bar E_i = d\, (\bar I_1 - 3) + (1 - 3d)(\bar I_i - 1)

(Holzapfel, Gasser & Ogden 2000, d = 0; Gasser, Ogden & Holzapfel 2006, Eq. 4.11). The families lie
in the plane of the tissue's axes f and s, which are for example circumferential and axial, at the
angles :math:`\pm\beta` (deg) from f, so that

.. math::
    \bar I_{4, 6} - 1 = \cos^2\!\beta\, (\bar I_{4f} - 1) + \sin^2\!\beta\, (\bar I_{4s} - 1)
        \pm \sin 2\beta\, \bar I_{8fs} .

Fibres resist extension only, which makes both laws polyconvex. For :math:`d = 1/3` fibres point in
all directions.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.holzapfel_ogden import energy_of_fibres
from emulator.mechanics.laws.law import Law, Quantity, modulus, number, quadratic_logarithmic


def energy(
    strain: Strain, c: jax.Array, k_1: jax.Array, k_2: jax.Array, angle: jax.Array, kappa: jax.Array
) -> jax.Array:
    """Return the strain energy density in kPa of parallel fibres; c, k_1, kappa in kPa."""
    return energy_dispersed(strain, c, k_1, k_2, angle, jnp.zeros(()), kappa)


def energy_dispersed(
    strain: Strain,
    c: jax.Array,
    k_1: jax.Array,
    k_2: jax.Array,
    angle: jax.Array,
    dispersion: jax.Array,
    kappa: jax.Array,
) -> jax.Array:
    """Return the strain energy density in kPa of dispersed fibres; c, k_1, kappa in kPa."""
    beta = jnp.deg2rad(angle)
    along = jnp.cos(beta) ** 2 * strain.isochoric_I4f_minus_1
    along += jnp.sin(beta) ** 2 * strain.isochoric_I4s_minus_1
    shear = jnp.sin(2.0 * beta) * strain.isochoric_I8fs
    change = strain.isochoric_I1_minus_3
    fibres = sum(
        energy_of_fibres(
            jnp.maximum(dispersion * change + (1.0 - 3.0 * dispersion) * stretch, 0.0), k_1, k_2
        )
        for stretch in (along + shear, along - shear)
    )
    return 0.5 * c * change + fibres + quadratic_logarithmic(strain, 0.25 * kappa)


_ANGLE = Quantity("angle", "deg", 0.0, 90.0)
_FIBRES = (modulus("c"), modulus("k_1"), number("k_2"), _ANGLE)
HOLZAPFEL_GASSER_OGDEN = Law(
    "holzapfel_gasser_ogden",
    (*_FIBRES, modulus("kappa")),
    energy,
    fibres=True,
    sheets=True,
    shape_moduli=("c", "k_1"),
    exponential=True,
)
GASSER_OGDEN_HOLZAPFEL = Law(
    "gasser_ogden_holzapfel",
    (*_FIBRES, number("dispersion", 0.0, 1.0 / 3.0), modulus("kappa")),
    energy_dispersed,
    fibres=True,
    sheets=True,
    shape_moduli=("c", "k_1"),
    exponential=True,
    simpler=(("fibre dispersion", HOLZAPFEL_GASSER_OGDEN),),
)
LAWS = (HOLZAPFEL_GASSER_OGDEN, GASSER_OGDEN_HOLZAPFEL)
