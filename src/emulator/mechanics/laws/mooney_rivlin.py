r"""Mooney-Rivlin and Yeoh materials: polynomials of the isochoric invariants.

.. math::
    W_\text{MR} &= c_{10} (\bar I_1 - 3) + c_{01} (\bar I_2 - 3) + U(J) \\
    W_\text{Yeoh} &= \sum_{k=1}^{3} c_k (\bar I_1 - 3)^k + U(J), \qquad
    U = \tfrac{\kappa}{4} (J^2 - 1 - 2 \ln J)

(Mooney 1940, Rivlin 1948; Yeoh 1993). Their shear moduli at rest are
:math:`2 (c_{10} + c_{01})` and :math:`2 c_1`. Mooney and Rivlin's is polyconvex; Yeoh's is where
:math:`c_2, c_3 \ge 0`, and may soften, and lose stability, where one of them is negative.
"""

from __future__ import annotations

import math

import jax

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law, Quantity, modulus, quadratic_logarithmic


def energy(strain: Strain, c_10: jax.Array, c_01: jax.Array, kappa: jax.Array) -> jax.Array:
    """Return Mooney and Rivlin's strain energy density in kPa; all parameters are in kPa."""
    shape = c_10 * strain.isochoric_I1_minus_3 + c_01 * strain.isochoric_I2_minus_3
    return shape + quadratic_logarithmic(strain, 0.25 * kappa)


def energy_yeoh(
    strain: Strain, c_1: jax.Array, c_2: jax.Array, c_3: jax.Array, kappa: jax.Array
) -> jax.Array:
    """Return Yeoh's strain energy density in kPa; all parameters are in kPa."""
    x = strain.isochoric_I1_minus_3
    return x * (c_1 + x * (c_2 + x * c_3)) + quadratic_logarithmic(strain, 0.25 * kappa)


_C_01 = Quantity("c_01", "kPa", low_admitted=True)
MOONEY_RIVLIN = Law(
    "mooney_rivlin",
    (modulus("c_10"), _C_01, modulus("kappa")),
    energy,
    shape_moduli=("c_10", "c_01"),
)
_SIGNED = tuple(Quantity(name, "kPa", -math.inf) for name in ("c_2", "c_3"))
YEOH = Law(
    "yeoh",
    (modulus("c_1"), *_SIGNED, modulus("kappa")),
    energy_yeoh,
    shape_moduli=("c_1", "c_2", "c_3"),
)
LAWS = (MOONEY_RIVLIN, YEOH)
