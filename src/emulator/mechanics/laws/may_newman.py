r"""May-Newman material of heart valves: one exponential of both strains.

.. math::
    W = c_0 \left(e^{Q} - 1\right) + \frac{\mu}{2} (\bar I_1 - 3)
        + \frac{\kappa}{4} (J^2 - 1 - 2 \ln J), \qquad
    Q = c_1 (\bar I_1 - 3)^2 + c_2 (\bar\lambda_f - 1)^4, \qquad
    \bar\lambda_f = \sqrt{\bar I_{4f}}

(May-Newman & Yin 1998) with :math:`c_0, \mu, \kappa` in kPa. The exponential has no stiffness at
rest, where its second derivative vanishes. A membrane that is stretched needs no matrix
(:math:`\mu`, which may be 0); a body at rest does. The energy is not polyconvex: fibres that are
shortened push.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law, Quantity, modulus, number, quadratic_logarithmic


def energy(
    strain: Strain, c_0: jax.Array, c_1: jax.Array, c_2: jax.Array, mu: jax.Array, kappa: jax.Array
) -> jax.Array:
    """Return the strain energy density in kPa; c_0, mu and kappa in kPa."""
    change, along = strain.isochoric_I1_minus_3, strain.isochoric_I4f_minus_1
    stretch = along / (1.0 + jnp.sqrt(1.0 + along))  # less 1, without cancellation
    Q = c_1 * change**2 + c_2 * stretch**4
    matrix = 0.5 * mu * change
    return c_0 * jnp.expm1(Q) + matrix + quadratic_logarithmic(strain, 0.25 * kappa)


_MATRIX = Quantity("mu", "kPa", low_admitted=True)
MAY_NEWMAN = Law(
    "may_newman",
    (modulus("c_0"), number("c_1"), number("c_2"), _MATRIX, modulus("kappa")),
    energy,
    fibres=True,
    shape_moduli=("c_0", "mu"),
    exponential=True,
)
LAWS = (MAY_NEWMAN,)
