r"""Energies of volume change for nearly incompressible laws.

==================  =============================================
quadratic           :math:`\frac{\kappa}{2} (J - 1)^2`
quadratic_logarithmic  :math:`\kappa (J^2 - 1 - 2 \ln J)`
logarithmic         :math:`\frac{\kappa}{2} (\ln J)^2`
==================  =============================================

Near :math:`J = 1` the second is :math:`2 \kappa (J - 1)^2`, four times as stiff as the others.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain

Volumetric = Callable[[Strain, jax.Array], jax.Array]


def quadratic(strain: Strain, kappa: jax.Array) -> jax.Array:
    """Return ``kappa/2 (J-1)^2`` in the unit of ``kappa``; finite even for an inverted point."""
    return 0.5 * kappa * strain.J_minus_1**2


def quadratic_logarithmic(strain: Strain, kappa: jax.Array) -> jax.Array:
    """Return ``kappa (J^2 - 1 - 2 ln J)`` in the unit of ``kappa``."""
    change = strain.J_minus_1
    # J^2 - 1 - 2 ln J = (J-1)^2 + 2 [(J-1) - ln J], without cancellation near J = 1.
    return kappa * (change**2 + 2.0 * (change - jnp.log1p(change)))


def logarithmic(strain: Strain, kappa: jax.Array) -> jax.Array:
    """Return ``kappa/2 (ln J)^2`` in the unit of ``kappa``."""
    return 0.5 * kappa * strain.ln_J**2
