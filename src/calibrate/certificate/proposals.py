r"""Where a certificate looks: Student-t kernels on draws, straightened, and the prior.

A posterior may be a thin, bent sheet. Its draws are straightened by a transport map of unit
Jacobian (:mod:`calibrate.samplers.transport`), so that one covariance :math:`\Sigma` describes
them, and a proposal is a mixture of kernels around some of them,

.. math:: q(\zeta) = \frac1K \sum_k t_\nu(\zeta; \zeta_k, h^2 \Sigma)

whose density is known at every point. Small :math:`h` follows the draws, large :math:`h` looks
beyond them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from calibrate.samplers import transport

CENTRES = 192  # kernels of a proposal
FITTED = 1024  # draws that the straightening is fitted to


@dataclass(frozen=True)
class Kernels:
    """Student-t kernels around draws, in straightened coordinates, each in several widths.

    centres : (k, p), straightened; root : lower triangle of the covariance's square root, (p, p).
    widths : h, all equally often; freedom : degrees of freedom.
    """

    map_: transport.TransportMap
    centres: np.ndarray
    root: np.ndarray
    widths: tuple[float, ...]
    freedom: float

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Points (count, p) in z."""
        chosen = self.centres[rng.integers(len(self.centres), size=count)]
        width = rng.choice(self.widths, size=(count, 1))
        scale = width * np.sqrt(self.freedom / rng.chisquare(self.freedom, size=(count, 1)))
        moved = chosen + scale * (rng.normal(size=chosen.shape) @ self.root.T)
        return transport.bend(self.map_, moved)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log densities (s,) in z; the map has unit Jacobian."""
        p, nu = z.shape[1], self.freedom
        whiten = np.linalg.inv(self.root).T
        points, centres = transport.straighten(self.map_, z) @ whiten, self.centres @ whiten
        square = (points**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1)
        square = np.maximum(square - 2.0 * points @ centres.T, 0.0)
        norm = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(nu * np.pi)
        norm -= np.log(np.diag(self.root)).sum() + np.log(len(centres) * len(self.widths))
        # Sums of powers, not of exponentials of logarithms: Student's tails do not underflow.
        tails = [
            (1.0 + square / (nu * h**2)) ** (-0.5 * (nu + p)) / h**p for h in self.widths
        ]  # fmt: skip
        return norm + np.log(sum(t.sum(axis=1) for t in tails))


def around(
    draws: np.ndarray, widths: tuple[float, ...], freedom: float, rng: np.random.Generator
) -> Kernels:
    """Kernels on some of the draws (s, p) of z."""
    rows = rng.permutation(len(draws))
    map_ = transport.fit(draws[rows[:FITTED]])
    straight = transport.straighten(map_, draws)
    covariance = np.atleast_2d(np.cov(straight, rowvar=False))
    # A coordinate that does not vary still gets a width, so that the density exists.
    root = np.linalg.cholesky(covariance + np.diag(1e-9 * np.diag(covariance) + 1e-12))
    return Kernels(map_, straight[rows[:CENTRES]], root, widths, freedom)
