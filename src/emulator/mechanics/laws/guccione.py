r"""Guccione material: one exponential of the Green-Lagrange strain along and across the fibres.

.. math::
    W &= \frac{C}{2} \left(e^{Q} - 1\right) + U(J) \\
    Q &= b_f E_{ff}^2 + b_t (E_{ss}^2 + E_{nn}^2 + 2 E_{sn}^2) + 2 b_{fs} (E_{fs}^2 + E_{fn}^2)

(Guccione et al. 1991; Dalton et al. 2023, Eq. 7), with :math:`E = (C - I)/2`. Q needs the fibre
direction only: :math:`E_{ss} + E_{nn}` and the sums of squares follow from the invariants of E,

.. math::
    Q = b_f E_{ff}^2 + b_t \left(E : E - 2 |E f|^2 + E_{ff}^2\right)
      + 2 b_{fs} \left(|E f|^2 - E_{ff}^2\right).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law, modulus, number, quadratic


def energy(
    strain: Strain, C: jax.Array, b_f: jax.Array, b_t: jax.Array, b_fs: jax.Array, kappa: jax.Array
) -> jax.Array:
    """Return the strain energy density in kPa; ``C`` and ``kappa`` in kPa."""
    E, f = strain.green_lagrange, strain.fibre
    Ef = E @ f
    along, shear = jnp.vdot(f, Ef), jnp.vdot(Ef, Ef)
    Q = (
        b_f * along**2
        + b_t * (jnp.sum(E * E) - 2.0 * shear + along**2)
        + 2.0 * b_fs * (shear - along**2)
    )
    return 0.5 * C * jnp.expm1(Q) + quadratic(strain, kappa)


_PARAMETERS = (modulus("C"), number("b_f"), number("b_t"), number("b_fs"), modulus("kappa"))
GUCCIONE = Law("guccione", _PARAMETERS, energy, fibres=True, shape_moduli=("C",), exponential=True)
LAWS = (GUCCIONE,)
