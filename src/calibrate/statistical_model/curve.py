r"""What a model is off by along a loading curve, so that a hundred points are not a hundred facts.

Points of a curve at amounts :math:`\gamma_j`, with values :math:`y_j`, are off together by

.. math:: \delta \sim N(0, C), \qquad
          C_{jk} = (\omega^2 y_j y_k + \sigma^2)\,
                   \big[c + (1 - c)\, k(|\gamma_j - \gamma_k| / \ell)\big]

with Matérn's kernel k of smoothness 3/2 (:mod:`calibrate.noise.spatial`): a share :math:`\omega` of
what was measured and :math:`\sigma` besides, of which the part c is the same along the whole curve.
"""

from __future__ import annotations

import numpy as np

from calibrate.noise.spatial import KERNELS
from emulator.errors import InputError

_LEAST = 1e-8  # of the largest variance: what no datum could tell


def curve_covariance(
    at: np.ndarray,
    values: np.ndarray,
    length: float,
    *,
    share: float = 0.0,
    sd: float = 0.0,
    constant: float = 0.0,
) -> np.ndarray:
    """C (n, n), in the unit of the data squared, at amounts ``at`` (n,) with ``values`` (n,).

    Raises
    ------
    InputError
        A length that is not above 0, or a constant part outside 0 to 1.
    """
    if not length > 0.0:
        raise InputError(f"length is {length}; it must be above 0, in the unit of the amount")
    if not 0.0 <= constant <= 1.0:
        raise InputError(f"constant is {constant}; it is a part, 0 to 1")
    near = KERNELS["matern32"](np.abs(at[:, None] - at) / length)
    return (share**2 * np.outer(values, values) + sd**2) * (constant + (1.0 - constant) * near)


def curve_modes(at: np.ndarray, values: np.ndarray, length: float, **sizes: float) -> np.ndarray:
    """Modes (r, n) of :func:`curve_covariance`, :math:`C = V^T V`: what one sd of each changes."""
    variances, vectors = np.linalg.eigh(curve_covariance(at, values, length, **sizes))
    kept = variances > _LEAST * max(float(variances.max()), 1e-300)
    return np.sqrt(variances[kept])[::-1, None] * vectors.T[kept][::-1]
