r"""Ogden materials: sums of powers of the principal stretches.

.. math::
    W = \sum_{p=1}^{N} \frac{2 \mu_p}{\alpha_p^2}
        \Big(\sum_{i=1}^{3} \bar\lambda_i^{\alpha_p} - 3\Big)
        + \frac{\kappa}{4} (J^2 - 1 - 2 \ln J), \qquad \bar\lambda_i = J^{-1/3} \lambda_i

(Ogden 1972) with :math:`\mu_p > 0` in kPa, whose sum is the shear modulus at rest, and exponents
:math:`\alpha_p \neq 0` of either sign. Terms with :math:`|\alpha_p| \ge 1` are polyconvex.

Principal stretches have no derivative where two are equal, while the energy has all of them there.
It is therefore evaluated without eigenvalues. With :math:`\bar C = e^{2h}`, so that
:math:`\operatorname{tr} h = 0`, the sum of powers is :math:`\operatorname{tr} e^{\alpha h}`. For
any multiple of h write

.. math:: x(t) = \operatorname{tr} e^{t h} - 3, \qquad y(t) = \operatorname{tr} e^{-t h} - 3 .

They double by :math:`\operatorname{tr} A^2 = (\operatorname{tr} A)^2 - 2 \operatorname{tr} A^{-1}`
for a matrix of determinant 1,

.. math:: x(2t) = 6 x - 2 y + x^2, \qquad y(2t) = 6 y - 2 x + y^2,

and halve by solving these two equations. From :math:`\bar I_1 - 3 = x(2)`,
:math:`\bar I_2 - 3 = y(2)`, eight halvings lead to a matrix so close to the identity that a few
terms of the exponential series, with power sums :math:`p_k = \operatorname{tr} (t h)^k`, suffice:

.. math::
    x + y &= p_2 + \tfrac{1}{24} p_2^2 + \dots, \qquad x - y = \tfrac13 p_3 + \tfrac{1}{72} p_2 p_3
        + \dots \\
    p_k &= \tfrac12 p_2\, p_{k-2} + \tfrac13 p_3\, p_{k-3} \quad \text{(Cayley and Hamilton)}

Scaled to a fraction of :math:`\alpha`, the series and doublings lead to the energy. All steps are
smooth functions of the two invariants, for every deformation.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws.law import Law, Quantity, modulus, quadratic_logarithmic

_HALVINGS, _DOUBLINGS = 8, 10
_APPROACH = 8  # iterations of the fixed point of a halving; each leaves a ninth of the error
_NEWTON = 3  # after which derivatives up to the seventh are those of the root
_ORDER = 9  # of the exponential series

Pair = tuple[jax.Array, jax.Array]
"""The traces x and y of a matrix of determinant 1 and of its inverse, each less 3."""


def energy(strain: Strain, *parameters: jax.Array) -> jax.Array:
    """Return the strain energy density in kPa from mu_1, alpha_1, ..., and kappa; moduli in kPa."""
    *terms, kappa = parameters
    power_sums = _logarithm((strain.isochoric_I1_minus_3, strain.isochoric_I2_minus_3))
    shape = sum(
        2.0 * mu / alpha**2 * _sum_of_powers(power_sums, alpha)
        for mu, alpha in zip(terms[::2], terms[1::2], strict=True)
    )
    return shape + quadratic_logarithmic(strain, 0.25 * kappa)


def _doubled(pair: Pair) -> Pair:
    x, y = pair
    return 6.0 * x - 2.0 * y + x**2, 6.0 * y - 2.0 * x + y**2


def _halved(pair: Pair) -> Pair:
    """Return the traces (x, y) of the matrix square root: ``_doubled((x, y)) == pair``."""
    X, Y = pair
    fixed_X, fixed_Y = jax.lax.stop_gradient(pair)
    u, v = jnp.sqrt(9.0 + fixed_X), jnp.sqrt(9.0 + fixed_Y)  # traces, as if the other's were 3
    for _ in range(_APPROACH):
        u, v = jnp.sqrt(3.0 + fixed_X + 2.0 * v), jnp.sqrt(3.0 + fixed_Y + 2.0 * u)
    x, y = u - 3.0, v - 3.0
    for _ in range(_NEWTON):
        traces = _doubled((x, y))
        a, b = X - traces[0], Y - traces[1]
        slope_x, slope_y = 6.0 + 2.0 * x, 6.0 + 2.0 * y
        determinant = slope_x * slope_y - 4.0  # 32 or more
        x, y = x + (slope_y * a + 2.0 * b) / determinant, y + (2.0 * a + slope_x * b) / determinant
    return x, y


def _repeated(step: Callable[[Pair], Pair], pair: Pair, times: int) -> Pair:
    """Return ``step`` applied several times, compiled once."""
    return jax.lax.fori_loop(0, times, lambda _, now: step(now), pair)


def _logarithm(pair: Pair) -> Pair:
    """Return the traces of the logarithm's square and cube."""
    x, y = _repeated(_halved, pair, _HALVINGS)
    even, odd = x + y, x - y
    # The series inverted; what is left out is below 1e-13 of each for stretches from 1/8 to 8.
    p2 = even - even**2 / 24.0 + even**3 / 360.0 - odd**2 / 120.0
    p2 += even * odd**2 / 840.0 - even**4 / 4480.0
    p3 = 3.0 * odd * (1.0 - even / 24.0 + even**2 / 360.0)
    scale = 2.0**_HALVINGS
    return scale**2 * p2, scale**3 * p3


def _series(p2: jax.Array, p3: jax.Array) -> Pair:
    """Return x and y from the traces of a small logarithm's square and cube."""
    sums = [jnp.full_like(p2, 3.0), jnp.zeros_like(p2), p2]
    even, odd = 0.5 * p2, jnp.zeros_like(p2)
    for k in range(3, _ORDER + 1):
        sums.append(p2 / 2.0 * sums[k - 2] + p3 / 3.0 * sums[k - 3])
        term = sums[k] / math.factorial(k)
        even, odd = (even, odd + term) if k % 2 else (even + term, odd)
    return even + odd, even - odd


def _sum_of_powers(power_sums: Pair, alpha: jax.Array) -> jax.Array:
    """Return the sum of the isochoric stretches to the power ``alpha``, less 3."""
    p2, p3 = power_sums  # of 2 h
    scale = 0.5 * alpha / 2.0**_DOUBLINGS
    return _repeated(_doubled, _series(scale**2 * p2, scale**3 * p3), _DOUBLINGS)[0]


def _ogden(terms: int) -> Law:
    pairs = [
        (modulus(f"mu_{k}"), Quantity(f"alpha_{k}", "", -math.inf)) for k in range(1, terms + 1)
    ]
    return Law(
        f"ogden_{terms}",
        (*(quantity for pair in pairs for quantity in pair), modulus("kappa")),
        energy,
        shape_moduli=tuple(mu.name for mu, _ in pairs),
    )


LAWS = tuple(map(_ogden, (1, 2, 3)))
