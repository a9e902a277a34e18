r"""Neo-Hookean materials.

Compressible,

.. math::
    W = \frac{\mu}{2}(I_1 - 3) - \mu \ln J + \frac{\lambda}{2} (\ln J)^2

in the Lamé parameters (kPa), Dalton et al. (2023), Section 3.1. The engineering constants give
:math:`\mu = E / 2(1+\nu)` and :math:`\lambda = E\nu / (1+\nu)(1-2\nu)`.

Split into change of shape and of volume, for nearly incompressible materials,

.. math::
    W = \frac{\mu}{2}\left(J^{-2/3} I_1 - 3\right) + \frac{\kappa}{4}(J^2 - 1 - 2 \ln J)

with the bulk modulus :math:`\kappa = 2\mu(1+\nu) / 3(1-2\nu)` in kPa. For small strains
:math:`\varepsilon` the first two are Hooke's law, whose tangent is the same everywhere,

.. math::
    W = \mu\, \varepsilon : \varepsilon
      + \frac{\lambda}{2} (\operatorname{tr} \varepsilon)^2 .
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law, modulus, number, quadratic_logarithmic


def energy_lame(strain: Strain, mu: jax.Array, lam: jax.Array) -> jax.Array:
    """Return the strain energy density in kPa from Lamé's parameters ``mu`` and ``lam`` (kPa)."""
    ln_J = strain.ln_J
    return 0.5 * mu * strain.I1_minus_3 - mu * ln_J + 0.5 * lam * ln_J**2


def lame_from_engineering(E: jax.Array, nu: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return ``(mu, lam)`` in the unit of Young's modulus ``E``; ``nu`` in (-1, 1/2)."""
    return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def energy_engineering(strain: Strain, E: jax.Array, nu: jax.Array) -> jax.Array:
    """Return the strain energy density in kPa from ``E`` (kPa) and Poisson's ratio ``nu``."""
    return energy_lame(strain, *lame_from_engineering(E, nu))


def energy_split(strain: Strain, mu: jax.Array, kappa: jax.Array) -> jax.Array:
    """Return the strain energy density in kPa from shear and bulk modulus ``mu``, ``kappa``."""
    return 0.5 * mu * strain.isochoric_I1_minus_3 + quadratic_logarithmic(strain, 0.25 * kappa)


def bulk_modulus(mu: float, nu: float) -> float:
    """Return ``kappa`` in the unit of ``mu``; Poisson's ratio ``nu`` in (-1, 1/2)."""
    return 2.0 * mu * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu))


def energy_small(strain: Strain, mu: jax.Array, lam: jax.Array) -> jax.Array:
    """Return the strain energy density in kPa of small strains, Hooke's law."""
    small = strain.small
    return mu * jnp.sum(small * small) + 0.5 * lam * jnp.trace(small) ** 2


def energy_small_engineering(strain: Strain, E: jax.Array, nu: jax.Array) -> jax.Array:
    """Return :func:`energy_small` from Young's modulus ``E`` (kPa) and Poisson's ratio ``nu``."""
    return energy_small(strain, *lame_from_engineering(E, nu))


_LAME = (modulus("mu"), modulus("lam"))
_ENGINEERING = (modulus("E"), number("nu", -1.0, 0.5))
SMALL_STRAIN = Law("small_strain", _LAME, energy_small, objective=False)
SMALL_STRAIN_E_NU = Law(
    "small_strain_E_nu", _ENGINEERING, energy_small_engineering, objective=False
)
NEO_HOOKEAN = Law(
    "neo_hookean",
    _LAME,
    energy_lame,
    shape_moduli=("mu",),
    simpler=(("finite strain", SMALL_STRAIN),),
)
NEO_HOOKEAN_E_NU = Law(
    "neo_hookean_E_nu",
    _ENGINEERING,
    energy_engineering,
    simpler=(("finite strain", SMALL_STRAIN_E_NU),),
)
NEO_HOOKEAN_SPLIT = Law(
    "neo_hookean_split", (modulus("mu"), modulus("kappa")), energy_split, shape_moduli=("mu",)
)
LAWS = (NEO_HOOKEAN, NEO_HOOKEAN_E_NU, NEO_HOOKEAN_SPLIT, SMALL_STRAIN, SMALL_STRAIN_E_NU)
