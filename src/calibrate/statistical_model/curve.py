r"""What a model is off by along a loading curve, so that a hundred points are not a hundred facts.

Points of a curve at amounts :math:`\gamma_j`, with values :math:`y_j`, are off together by

.. math:: \delta \sim N(0, C), \qquad
          C_{jk} = (\omega^2 y_j y_k + \sigma^2)\,
                   \big[c + (1 - c)\, k(|\gamma_j - \gamma_k| / \ell)\big]

with Matérn's kernel :math:`k(s) = (1 + \sqrt3 s)\, e^{-\sqrt3 s}` of smoothness 3/2: a share
:math:`\omega` of the values and :math:`\sigma` besides, of which the part c is the same along the
whole curve.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError

Number = float | jax.Array

_LEAST = 1e-8  # of the largest variance: what no datum could tell


def curve_covariance(
    at: jax.Array,
    values: jax.Array,
    length: Number,
    *,
    share: Number = 0.0,
    sd: Number = 0.0,
    constant: Number = 0.0,
) -> jax.Array:
    """C (..., n, n) of points at amounts ``at`` (..., n) with ``values`` (..., n).

    Parameters
    ----------
    length : () or (..., 1, 1), in the unit of ``at``.
    share : omega. sd : sigma, in the unit of ``values``.
    constant : c, 0 to 1.
    """
    apart = jnp.sqrt(3.0) * jnp.abs(at[..., :, None] - at[..., None, :]) / length
    shape = constant + (1.0 - constant) * (1.0 + apart) * jnp.exp(-apart)
    return (share**2 * values[..., :, None] * values[..., None, :] + sd**2) * shape


def curve_modes(at: np.ndarray, length: float, *, constant: float = 0.0) -> np.ndarray:
    """Modes (r, n) of :func:`curve_covariance` with sd 1, :math:`C = V^T V`."""
    none = jnp.zeros(len(at))
    C = curve_covariance(jnp.asarray(at), none, length, sd=1.0, constant=constant)
    variances, vectors = np.linalg.eigh(np.asarray(C))
    kept = variances > _LEAST * max(float(variances.max()), 1e-300)
    return np.sqrt(variances[kept])[::-1, None] * vectors.T[kept][::-1]


def check_curve(length: float, constant: float) -> None:
    """:class:`InputError` on a length that is not above 0, or a constant part outside 0 to 1."""
    if not length > 0.0:
        raise InputError(f"length is {length}; it must be above 0, in the unit of the amount")
    if not 0.0 <= constant <= 1.0:
        raise InputError(f"constant is {constant}; it is a part, 0 to 1")
