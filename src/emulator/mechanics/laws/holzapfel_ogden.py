r"""Holzapfel-Ogden material with one family of fibres (transversely isotropic).

Textbook form (Holzapfel & Ogden 2009; Dalton et al. 2023, Eq. 4 and 6), with isochoric invariants
:math:`\bar I_1 = J^{-2/3} I_1`, :math:`\bar I_{4f} = J^{-2/3}\, f_0 \cdot C f_0` and fibres that
resist stretch only, :math:`\langle x \rangle = \max(x, 0)`:

.. math::
    W = \frac{a}{2b}\left[e^{b(\bar I_1 - 3)} - 1\right]
      + \frac{a_f}{2b_f}\left[e^{b_f \langle \bar I_{4f} - 1 \rangle^2} - 1\right] + U(J)

Two effects can be left out: the switch, so that fibres resist being shortened as they do being
stretched, and the fibres. The released variant behind the paper's published solutions has no
factors 1/2 and no switch; its ``a`` and ``a_f`` are half the textbook's. All have the volumetric
part ``quadratic_logarithmic`` (:mod:`~emulator.mechanics.laws.law`) with the parameter
kappa.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law, modulus, number, quadratic_logarithmic


def energy(
    strain: Strain, a: jax.Array, b: jax.Array, a_f: jax.Array, b_f: jax.Array, kappa: jax.Array
) -> jax.Array:
    """Return the strain energy density in kPa, textbook form; ``a``, ``a_f``, ``kappa`` in kPa."""
    stretch = jnp.maximum(strain.isochoric_I4f_minus_1, 0.0)
    return energy_isotropic(strain, a, b, kappa) + energy_of_fibres(stretch, a_f, b_f)


def energy_released(
    strain: Strain, a: jax.Array, b: jax.Array, a_f: jax.Array, b_f: jax.Array, kappa: jax.Array
) -> jax.Array:
    """Return the strain energy density in kPa as in the paper's released code."""
    matrix = a / b * jnp.expm1(b * strain.isochoric_I1_minus_3)
    fibres = a_f / b_f * jnp.expm1(b_f * strain.isochoric_I4f_minus_1**2)
    return matrix + fibres + quadratic_logarithmic(strain, kappa)


def energy_unswitched(
    strain: Strain, a: jax.Array, b: jax.Array, a_f: jax.Array, b_f: jax.Array, kappa: jax.Array
) -> jax.Array:
    """Return the strain energy density in kPa of fibres that resist compression, too."""
    stretch = strain.isochoric_I4f_minus_1
    return energy_isotropic(strain, a, b, kappa) + energy_of_fibres(stretch, a_f, b_f)


def energy_isotropic(strain: Strain, a: jax.Array, b: jax.Array, kappa: jax.Array) -> jax.Array:
    """Return the strain energy density in kPa without fibres."""
    matrix = a / (2.0 * b) * jnp.expm1(b * strain.isochoric_I1_minus_3)
    return matrix + quadratic_logarithmic(strain, kappa)


def energy_of_fibres(stretch: jax.Array, a_f: jax.Array, b_f: jax.Array) -> jax.Array:
    """Return the energy density () in kPa of fibres at ``stretch``, squared and less 1."""
    return a_f / (2.0 * b_f) * jnp.expm1(b_f * stretch**2)


_PARAMETERS = (modulus("a"), number("b"), modulus("a_f"), number("b_f"), modulus("kappa"))
HOLZAPFEL_OGDEN_ISOTROPIC = Law(
    "holzapfel_ogden_isotropic",
    (modulus("a"), number("b"), modulus("kappa")),
    energy_isotropic,
    shape_moduli=("a",),
    exponential=True,
)
_WITHOUT_FIBRES = (("fibres", HOLZAPFEL_OGDEN_ISOTROPIC),)
HOLZAPFEL_OGDEN_UNSWITCHED = Law(
    "holzapfel_ogden_unswitched",
    _PARAMETERS,
    energy_unswitched,
    fibres=True,
    shape_moduli=("a", "a_f"),
    exponential=True,
    simpler=_WITHOUT_FIBRES,
)
HOLZAPFEL_OGDEN = replace(
    HOLZAPFEL_OGDEN_UNSWITCHED,
    name="holzapfel_ogden",
    energy=energy,
    simpler=(("tension switch", HOLZAPFEL_OGDEN_UNSWITCHED), *_WITHOUT_FIBRES),
)
HOLZAPFEL_OGDEN_RELEASED = replace(
    HOLZAPFEL_OGDEN, name="holzapfel_ogden_released", energy=energy_released, simpler=()
)
LAWS = (
    HOLZAPFEL_OGDEN,
    HOLZAPFEL_OGDEN_UNSWITCHED,
    HOLZAPFEL_OGDEN_ISOTROPIC,
    HOLZAPFEL_OGDEN_RELEASED,
)


def textbook_from_released(a: float, a_f: float) -> tuple[float, float]:
    """Return textbook ``(a, a_f)`` of equal energies in fibre tension from the released ones."""
    return 2.0 * a, 2.0 * a_f
