r"""Polynomials of theta fitted to values of known error.

.. math:: \min_c \sum_i \frac{|v_i - \sum_\alpha c_\alpha P_\alpha(x_i)|^2}{(\epsilon_i + s)^2}

for values :math:`v_i` with errors of about :math:`\epsilon_i`, where :math:`s` is about what the
polynomial itself leaves, in the terms of :mod:`emulator.surrogates.polynomial`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from emulator.surrogates.polynomial import degrees_up_to, legendre, terms

MOST_TERMS = 500
_PLENTY = 1.3  # values a term, at least


class Values(NamedTuple):
    """Fields at positions in the unit box.

    position : (c, p). fields : (c, f) mm. error : (c,) mm, of each.
    """

    position: np.ndarray
    fields: np.ndarray
    error: np.ndarray

    def take(self, rows: slice | np.ndarray) -> Values:
        """Some of them."""
        return Values(*(array[rows] for array in self))

    def followed_by(self, others: Values) -> Values:
        """These and ``others``."""
        return Values(*(np.concatenate(both) for both in zip(self, others, strict=True)))


class Fitted(NamedTuple):
    """A polynomial. degrees : (m, p) of each term. coefficients : (m, f) mm."""

    degrees: np.ndarray
    coefficients: np.ndarray

    @property
    def degree(self) -> int:
        """The largest sum of degrees."""
        return int(self.degrees.sum(axis=1).max())

    def at(self, position: np.ndarray) -> np.ndarray:
        """The fields (c, f) at ``position`` (c, p)."""
        return legendre(position, self.degrees) @ self.coefficients


def fit(values: Values, degree: int, left: float) -> Fitted:
    """The polynomial of ``degree``, or of as much as there are values for.

    left : about what it leaves, mm, and positive.
    """
    while degree > 0 and terms(values.position.shape[1], degree) > len(values.position):
        degree -= 1
    degrees = degrees_up_to(values.position.shape[1], degree)
    left = max(left, np.finfo(float).tiny)  # where every value is the polynomial's own
    weight = (left / (values.error + left))[:, None]
    rows = weight * legendre(values.position, degrees)
    q, r = scipy.linalg.qr(rows, mode="economic")
    return Fitted(degrees, scipy.linalg.solve_triangular(r, q.T @ (weight * values.fields)))


def best_degree(known: Values, new: Values, now: int, left: float) -> int:
    """Of the degree ``now`` and its neighbours, the one whose fit to ``known`` is nearest to
    ``new`` values, which no fit has seen; ``now`` where there are too few for any.
    """  # noqa: D205
    parameters, off = new.position.shape[1], {}
    for degree in range(max(now - 1, 1), now + 2):
        count = terms(parameters, degree)
        if count <= MOST_TERMS and count * _PLENTY <= len(known.position):
            missed = fit(known, degree, left).at(new.position) - new.fields
            off[degree] = float(np.median(np.sum(missed**2, axis=1)))
    return min(off, key=off.__getitem__) if off else now
