r"""Polynomials of theta: a part of an emulator, and their fit to fields of known error.

.. math:: u(x) = \sum_k c_k(x)\, \phi_k, \qquad
    c_k(x) = \sum_{|\alpha| \le d} w_{\alpha k}
        \prod_j \sqrt{2 \alpha_j + 1}\, P_{\alpha_j}(2 x_j - 1)

with :math:`x` theta's position in the unit box and the Legendre polynomials :math:`P_k`. The terms
have a mean square of 1 over the box and no mean product with each other, so that a singular value
decomposition of the fields' coefficients leaves out the smallest modes over the box.

The fit to fields :math:`v_i` with errors of about :math:`\epsilon_i` is

.. math:: \min_c \sum_i \frac{|v_i - \sum_\alpha c_\alpha P_\alpha(x_i)|^2}{(\epsilon_i + s)^2}

where :math:`s` is about the error of the polynomial itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb, sqrt
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from emulator.surrogates.part import ArrayPart, CachedPart

MOST_TERMS = 500
"""The largest number of terms that a polynomial is fitted with."""
_PLENTY = 1.3  # least number of fields for each term


@dataclass(frozen=True, eq=False)
class Polynomial(ArrayPart):
    """A polynomial of theta, a part of an emulator.

    degrees : the degrees alpha of each term, (m, p).
    weights : the weight of each term in each coefficient, (m, r).
    modes : the modes, (r, n, 3) mm.
    """

    degrees: np.ndarray
    weights: np.ndarray
    modes: np.ndarray

    def coefficients(self, position: jax.Array) -> jax.Array:
        """Return the coefficients (..., r) at ``position`` (..., p) in the unit box."""
        return legendre(position, self.degrees) @ self.weights

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (..., n, 3) mm at ``position`` (..., p) in the unit box."""
        return jnp.tensordot(self.coefficients(position), self.modes, axes=1)

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Return the polynomial over ``nodes`` (k,)."""
        modes = self.modes[:, nodes]
        return CachedPart(np.zeros(modes.shape[1:]), modes, self.coefficients)


def compressed(degrees: np.ndarray, fields: np.ndarray, error: float) -> Polynomial:
    """Return a polynomial with as few modes as its error allows.

    degrees, fields : the degrees (m, p) and the fields (m, n, 3) mm of its terms.
    error : the allowed root mean square difference over box and nodes, mm.
    """
    flat = fields.reshape(len(fields), -1)
    left, sizes, right = np.linalg.svd(flat, full_matrices=False)
    beyond = np.sqrt(np.cumsum(sizes[::-1] ** 2)[::-1] / fields.shape[1])
    rank = max(int(np.sum(beyond > error)), 1)
    modes = sizes[:rank, None] * right[:rank]
    rounded = modes.astype(np.float32).astype(float)
    off = np.sum((rounded - modes) ** 2) + np.sum(sizes[rank:] ** 2)
    if off <= error**2 * fields.shape[1]:
        modes = rounded  # which halves the file
    return Polynomial(degrees, left[:, :rank], modes.reshape(rank, *fields.shape[1:]))


def terms(parameters: int, degree: int) -> int:
    """Return the number of terms of a polynomial of ``degree`` in ``parameters`` variables."""
    return comb(parameters + degree, degree)


def degrees_up_to(parameters: int, degree: int) -> np.ndarray:
    """Return all alpha (m, p) with a sum of ``degree`` or less, sorted by that sum."""
    degrees = [
        np.bincount(np.array(term, dtype=int), minlength=parameters)
        for total in range(degree + 1)
        for term in combinations_with_replacement(range(parameters), total)
    ]
    return np.array(degrees)


def legendre(position: Any, degrees: np.ndarray) -> Any:
    """Return the terms (..., m) of ``degrees`` (m, p) at ``position`` (..., p).

    It computes with NumPy where the position is NumPy's, because each shape would be compiled.
    """
    xp: Any = np if isinstance(position, np.ndarray) else jnp
    t = 2.0 * position - 1.0
    rows = [xp.ones_like(t), t]
    for k in range(1, int(degrees.max())):
        rows.append(((2 * k + 1) * t * rows[k] - k * rows[k - 1]) / (k + 1))
    factors = xp.stack([sqrt(2 * k + 1) * row for k, row in enumerate(rows)], axis=-1)
    return xp.prod(factors[..., np.arange(degrees.shape[1]), degrees], axis=-1)


class Samples(NamedTuple):
    """Fields at positions in the unit box.

    position : (c, p). fields : (c, f) mm. error : the error of each field, (c,) mm.
    """

    position: np.ndarray
    fields: np.ndarray
    error: np.ndarray

    def take(self, rows: slice | np.ndarray) -> Samples:
        """Return the samples in ``rows``."""
        return Samples(*(array[rows] for array in self))

    def followed_by(self, more: Samples) -> Samples:
        """Return these samples and ``more``."""
        return Samples(*(np.concatenate(both) for both in zip(self, more, strict=True)))


class PolynomialFit(NamedTuple):
    """A fitted polynomial: degrees (m, p) and coefficients (m, f) mm of its terms."""

    degrees: np.ndarray
    coefficients: np.ndarray

    @property
    def degree(self) -> int:
        """The largest sum of degrees."""
        return int(self.degrees.sum(axis=1).max())

    def at(self, position: np.ndarray) -> np.ndarray:
        """Return the fields (c, f) mm at ``position`` (c, p)."""
        return legendre(position, self.degrees) @ self.coefficients


def fit(samples: Samples, degree: int, own_error: float) -> PolynomialFit:
    """Return the polynomial of ``degree``, or of the largest one for which there are samples.

    own_error : the estimated error of the polynomial itself, mm.
    """
    while degree > 0 and terms(samples.position.shape[1], degree) > len(samples.position):
        degree -= 1
    degrees = degrees_up_to(samples.position.shape[1], degree)
    own_error = max(own_error, np.finfo(float).tiny)  # 0 for exact polynomials
    weight = (own_error / (samples.error + own_error))[:, None]
    rows = weight * legendre(samples.position, degrees)
    q, r = scipy.linalg.qr(rows, mode="economic")
    return PolynomialFit(degrees, scipy.linalg.solve_triangular(r, q.T @ (weight * samples.fields)))


def best_degree(known: Samples, new: Samples, degree: int, own_error: float) -> int:
    """Return ``degree`` or a neighbour, whichever fit to ``known`` predicts ``new`` best.

    No fit has seen the new samples. The degree stays where there are too few for any fit.
    """
    parameters, misfits = new.position.shape[1], {}
    for trial in range(max(degree - 1, 1), degree + 2):
        count = terms(parameters, trial)
        if count <= MOST_TERMS and count * _PLENTY <= len(known.position):
            error = fit(known, trial, own_error).at(new.position) - new.fields
            misfits[trial] = float(np.median(np.sum(error**2, axis=1)))
    return min(misfits, key=misfits.__getitem__) if misfits else degree
