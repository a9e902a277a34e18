r"""A polynomial of theta as a part of an emulator.

.. math:: u(x) = \sum_k c_k(x)\, \phi_k, \qquad
    c_k(x) = \sum_{|\alpha| \le d} w_{\alpha k}
        \prod_j \sqrt{2 \alpha_j + 1}\, P_{\alpha_j}(2 x_j - 1)

with :math:`x` theta's position in the unit box and the Legendre polynomials :math:`P_k`. The terms
have a mean square of 1 over the box and no mean product with each other, so that a singular value
decomposition of the fields' coefficients leaves out what is least over the box.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb, sqrt
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from emulator.scenes.scene import Scene
from emulator.surrogates.part import CachedPart, OfArrays, widened


@dataclass(frozen=True, eq=False)
class Polynomial(OfArrays):
    """Displacement as a polynomial, a part of an emulator.

    degrees : (m, p) alpha of each term. weights : (m, r). modes : (r, n, 3) mm.
    """

    degrees: np.ndarray
    weights: np.ndarray
    modes: np.ndarray

    def coefficients(self, position: jax.Array) -> jax.Array:
        """Of the modes, (..., r), at ``position`` (..., p) in the unit box."""
        return legendre(position, self.degrees) @ self.weights

    def __call__(self, position: jax.Array) -> jax.Array:
        """Displacement (..., n, 3) mm at ``position`` (..., p) in the unit box."""
        return jnp.tensordot(self.coefficients(position), self.modes, axes=1)

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """The polynomial over ``nodes`` (k,)."""
        modes = self.modes[:, nodes]
        return CachedPart(np.zeros(modes.shape[1:]), modes, self.coefficients)

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """The polynomial with these arrays."""
        del scene, description
        return cls(*(widened(arrays[name]) for name in ("degrees", "weights", "modes")))


def compressed(degrees: np.ndarray, fields: np.ndarray, error: float) -> Polynomial:
    """The polynomial with the fields (m, n, 3) mm of its terms, in as few modes as it needs.

    error : mm, root mean square over box and nodes, that it may differ by.
    """
    flat = fields.reshape(len(fields), -1)
    left, sizes, right = np.linalg.svd(flat, full_matrices=False)
    beyond = np.sqrt(np.cumsum(sizes[::-1] ** 2)[::-1] / fields.shape[1])
    kept = max(int(np.sum(beyond > error)), 1)
    modes = sizes[:kept, None] * right[:kept]
    rounded = modes.astype(np.float32).astype(float)
    off = np.sum((rounded - modes) ** 2) + np.sum(sizes[kept:] ** 2)
    if off <= error**2 * fields.shape[1]:
        modes = rounded  # files then take half of the room
    return Polynomial(degrees, left[:, :kept], modes.reshape(kept, *fields.shape[1:]))


def terms(parameters: int, degree: int) -> int:
    """Number of terms of a polynomial of ``degree`` in so many ``parameters``."""
    return comb(parameters + degree, degree)


def degrees_up_to(parameters: int, degree: int) -> np.ndarray:
    """All alpha (m, p) with a sum of ``degree`` or less, by that sum."""
    chosen = [
        np.bincount(np.array(term, dtype=int), minlength=parameters)
        for total in range(degree + 1)
        for term in combinations_with_replacement(range(parameters), total)
    ]
    return np.array(chosen)


def legendre(position: Any, degrees: np.ndarray) -> Any:
    """Terms (..., m) of ``degrees`` (m, p) at ``position`` (..., p), of mean square 1.

    NumPy's where the position is, whose shapes are many.
    """
    xp: Any = np if isinstance(position, np.ndarray) else jnp
    t = 2.0 * position - 1.0
    rows = [xp.ones_like(t), t]
    for k in range(1, int(degrees.max())):
        rows.append(((2 * k + 1) * t * rows[k] - k * rows[k - 1]) / (k + 1))
    each = xp.stack([sqrt(2 * k + 1) * row for k, row in enumerate(rows)], axis=-1)
    return xp.prod(each[..., np.arange(degrees.shape[1]), degrees], axis=-1)
