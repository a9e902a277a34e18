r"""Holzapfel-Ogden material whose fibres are dispersed about their mean direction.

.. math::
    W = \frac{a}{2b}\left[e^{b(\bar I_1 - 3)} - 1\right]
      + \frac{a_f}{2b_f}\left[e^{b_f \langle \bar E \rangle^2} - 1\right] + U(J), \qquad
    \bar E = d\, (\bar I_1 - 3) + (1 - 3 d)(\bar I_{4f} - 1)

with the dispersion :math:`d` of Gasser, Ogden & Holzapfel (2006, Eq. 4.11), 0 for parallel fibres
and 1/3 for fibres in all directions, and the switch of
:mod:`~emulator.mechanics.laws.holzapfel_ogden`, here on their mean strain. For :math:`d = 0` it is
that law. Dispersion, switch and fibres can be left out.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.holzapfel_ogden import (
    HOLZAPFEL_OGDEN,
    HOLZAPFEL_OGDEN_ISOTROPIC,
    HOLZAPFEL_OGDEN_UNSWITCHED,
    energy_isotropic,
    energy_of_fibres,
)
from emulator.mechanics.laws.law import Law, modulus, number


def energy(
    strain: Strain,
    a: jax.Array,
    b: jax.Array,
    a_f: jax.Array,
    b_f: jax.Array,
    dispersion: jax.Array,
    kappa: jax.Array,
) -> jax.Array:
    """Return the strain energy density in kPa; ``a``, ``a_f`` and ``kappa`` in kPa."""
    stretch = jnp.maximum(mean_stretch(strain, dispersion), 0.0)
    return energy_isotropic(strain, a, b, kappa) + energy_of_fibres(stretch, a_f, b_f)


def energy_unswitched(
    strain: Strain,
    a: jax.Array,
    b: jax.Array,
    a_f: jax.Array,
    b_f: jax.Array,
    dispersion: jax.Array,
    kappa: jax.Array,
) -> jax.Array:
    """Return the strain energy density in kPa of fibres that resist compression, too."""
    stretch = mean_stretch(strain, dispersion)
    return energy_isotropic(strain, a, b, kappa) + energy_of_fibres(stretch, a_f, b_f)


def mean_stretch(strain: Strain, dispersion: jax.Array) -> jax.Array:
    r"""Return the fibres' mean :math:`\bar E`, stretch squared and less 1, shape ()."""
    along = (1.0 - 3.0 * dispersion) * strain.isochoric_I4f_minus_1
    return dispersion * strain.isochoric_I1_minus_3 + along


_FIBRES = (modulus("a_f"), number("b_f"), number("dispersion", 0.0, 1.0 / 3.0))
HOLZAPFEL_OGDEN_DISPERSED_UNSWITCHED = Law(
    "holzapfel_ogden_dispersed_unswitched",
    (modulus("a"), number("b"), *_FIBRES, modulus("kappa")),
    energy_unswitched,
    fibres=True,
    shape_moduli=("a", "a_f"),
    exponential=True,
    simpler=(
        ("fibre dispersion", HOLZAPFEL_OGDEN_UNSWITCHED),
        ("fibres", HOLZAPFEL_OGDEN_ISOTROPIC),
    ),
)
HOLZAPFEL_OGDEN_DISPERSED = replace(
    HOLZAPFEL_OGDEN_DISPERSED_UNSWITCHED,
    name="holzapfel_ogden_dispersed",
    energy=energy,
    simpler=(
        ("tension switch", HOLZAPFEL_OGDEN_DISPERSED_UNSWITCHED),
        ("fibre dispersion", HOLZAPFEL_OGDEN),
        ("fibres", HOLZAPFEL_OGDEN_ISOTROPIC),
    ),
)
LAWS = (HOLZAPFEL_OGDEN_DISPERSED, HOLZAPFEL_OGDEN_DISPERSED_UNSWITCHED)
