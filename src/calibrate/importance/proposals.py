r"""Many cheap points, weighted as draws of the mixture of all proposals that they come from.

With :math:`n_c` of :math:`M` points from proposal :math:`q_c`, every point is weighted by the
mixture (the balance heuristic; Veach and Guibas 1995, Elvira et al. 2019),

.. math:: w_i \propto \frac{\pi(z_i)}{q(z_i)}, \qquad q = \sum_c \frac{n_c}{M} q_c

so that a weight is large only where no proposal has its mass. From the prior, proposals move to a
posterior by themselves: each step puts kernels around points resampled with weights
:math:`w^\beta`, with :math:`\beta` rising to 1 as fast as the effective number of points allows
(nonlinear population Monte Carlo; Koblents and Miguez 2015).

A proposal is a mixture of Student-t kernels around points. A posterior may be a thin, bent sheet.
Its points are straightened by a transport map of unit Jacobian
(:mod:`calibrate.importance.transport`) so that one covariance :math:`\Sigma` describes them, and

.. math:: q_c(\zeta) = \frac1K \sum_k t_\nu(\zeta; \zeta_k, h^2 \Sigma)

is known at every point. Small widths :math:`h` follow the points, large ones surround them. Points
in separate places, as of a posterior with several modes, have a map and a covariance each.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from scipy.cluster.vq import ClusterError, kmeans2
from scipy.optimize import brentq
from scipy.special import gammaln, logsumexp

from calibrate.importance import transport
from calibrate.importance.weights import effective, normalised

MOST_TEMPERED = 300.0  # effective points that the kernels of the next step are put on, at most
TEMPERED_SHARE = 0.15  # that number at most, as a share of all points
STEP = 512  # points of a step
_RESAMPLED = 1024  # points that a step's kernels are put around
_FREEDOM = 5.0  # degrees of freedom of the kernels
_WIDE_WIDTHS, _WIDE_FREEDOM = (1.0, 2.0), 3.0
_CENTRES = 192  # kernels of a proposal
_FITTED = 1024  # points to which the straightening is fitted
_MOST_GROUPS = 8
_SEPARATE = 3.0  # gain in log det of the covariance from which points are in separate places


def key_from(rng: np.random.Generator) -> jax.Array:
    """Return a JAX key drawn from NumPy's generator."""
    return jax.random.key(int(rng.integers(2**31)))


class Group(NamedTuple):
    """Kernels of one covariance.

    map_ : the transport map from straightened coordinates to z.
    centres : the centres (k, p), straightened.
    root : the factor R (p, p) of the covariance, R R^T.
    kernels : the number of kernels, as many at each centre.
    """

    map_: transport.TransportMap
    centres: np.ndarray
    root: np.ndarray
    kernels: int

    @classmethod
    def of(cls, z: np.ndarray, centres: int) -> Group:
        """Return kernels around the first ``centres`` of points z (s, p), of their covariance."""
        map_ = transport.fit(z[:_FITTED])
        straight = transport.straighten(map_, z)
        covariance = np.atleast_2d(np.cov(straight, rowvar=False))
        # A coordinate that does not vary still gets a width, so that the density exists.
        root = np.linalg.cholesky(covariance + np.diag(1e-9 * np.diag(covariance) + 1e-12))
        return cls(map_, straight[:centres], root, len(straight[:centres]))

    @classmethod
    def at_mode(cls, z: np.ndarray, root: np.ndarray, count: int) -> Group:
        """Return ``count`` kernels at z (p,), of covariance R R^T with R = ``root`` (p, p)."""
        return cls(transport.standard_identity(len(z)).bend, z[None], root, count)

    def at(self, rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return points z (s, p) at white ``steps`` (s, p) from the centres ``rows`` (s,)."""
        return transport.bend(self.map_, self.centres[rows] + steps @ self.root.T)

    def log_sums(self, z: np.ndarray, widths: Sequence[float], freedom: float) -> np.ndarray:
        """Return the logarithm (s,) of the sum of the kernels at points z (s, p)."""
        p, nu = z.shape[1], freedom
        whiten = np.linalg.inv(self.root).T
        points, centres = transport.straighten(self.map_, z) @ whiten, self.centres @ whiten
        square = (points**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1)
        square = np.maximum(square - 2.0 * points @ centres.T, 0.0)
        norm = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(nu * np.pi)
        norm += np.log(self.kernels / len(centres)) - np.linalg.slogdet(self.root)[1]
        # Sums of powers, not of exponentials of logarithms: Student's tails do not underflow.
        tails = [(1.0 + square / (nu * h**2)) ** (-0.5 * (nu + p)) / h**p for h in widths]
        return norm + np.log(sum(t.sum(axis=1) for t in tails))


@dataclass(frozen=True)
class Kernels:
    """A mixture of Student-t kernels, each with the covariance of its group.

    groups : the groups; several where the points are in several places.
    widths : the factors h of the kernels' sd, all equally often.
    freedom : the degrees of freedom.
    """

    groups: tuple[Group, ...]
    widths: tuple[float, ...]
    freedom: float

    @classmethod
    def around(
        cls,
        z: np.ndarray,
        widths: tuple[float, ...],
        freedom: float,
        rng: np.random.Generator,
        *,
        centres: int = _CENTRES,
    ) -> Kernels:
        """Return kernels around some of the points z (s, p), with the covariance of all.

        Points in separate places get a covariance each (:func:`separate`).

        centres : the number of kernels.
        """
        mixed = z[rng.permutation(len(z))]
        parts = separate(mixed)
        groups = [Group.of(mixed[rows], int((rows < centres).sum())) for rows in parts]
        return cls(tuple(group for group in groups if len(group.centres)), widths, freedom)

    @classmethod
    def following(cls, z: np.ndarray, rng: np.random.Generator) -> Kernels:
        """Return narrow kernels, which smooth the density of the points z (s, p)."""
        # In many dimensions narrower kernels would not overlap.
        widths = (0.15, 0.5) if z.shape[1] <= 2 else (0.35, 0.7)
        return cls.around(z, widths, _FREEDOM, rng)

    @classmethod
    def surrounding(cls, z: np.ndarray, rng: np.random.Generator) -> Kernels:
        """Return kernels of one and two sd of the points z (s, p), which look beyond them."""
        return cls.around(z, _WIDE_WIDTHS, _WIDE_FREEDOM, rng)

    @property
    def sizes(self) -> list[int]:
        """Number of kernels of each group."""
        return [group.kernels for group in self.groups]

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return points z (count, p)."""
        ends = np.cumsum(self.sizes)
        rows = rng.integers(ends[-1], size=count)
        width = rng.choice(self.widths, size=(count, 1))
        scale = width * np.sqrt(self.freedom / rng.chisquare(self.freedom, size=(count, 1)))
        z = scale * rng.normal(size=(count, self.groups[0].centres.shape[1]))
        for group, begin, end in zip(self.groups, [0, *ends], ends, strict=False):
            members = (rows >= begin) & (rows < end)
            z[members] = group.at((rows[members] - begin) % len(group.centres), z[members])
        return z

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Return log densities (s,) at points z (s, p); the maps have unit Jacobian."""
        sums = [group.log_sums(z, self.widths, self.freedom) for group in self.groups]
        return logsumexp(sums, axis=0) - np.log(sum(self.sizes) * len(self.widths))


def separate(z: np.ndarray) -> list[np.ndarray]:
    r"""Return rows of points z (s, p) in separate places, a part each, by repeated halving.

    A set is parted in two by k-means if that lowers the mean :math:`\log\det` of the parts'
    covariances by more than 3: by 1.01 for halves of a Gaussian, 1.39 of a uniform density.
    """
    parts: list[np.ndarray] = []
    waiting = [np.arange(len(z))]
    while waiting:
        rows = waiting.pop()
        halves = _halved(z[rows]) if len(parts) + len(waiting) < _MOST_GROUPS - 1 else None
        if halves is None:
            parts.append(rows)
        else:
            waiting += [rows[halves], rows[~halves]]
    return parts


def _halved(z: np.ndarray) -> np.ndarray | None:
    """Return which of the points z (s, p) are in the first of two separate places, if they are."""
    covariance, fewest = np.atleast_2d(np.cov(z, rowvar=False)), 4 * (z.shape[1] + 1)
    values, vectors = np.linalg.eigh(covariance)
    # Round-off would part points along a coordinate that does not vary.
    if len(z) < 2 * fewest or not values[0] > 1e-12 * values[-1]:
        return None
    white = (z - z.mean(axis=0)) @ (vectors / np.sqrt(values))
    best, halves, whole = _SEPARATE, None, np.log(values).sum()
    for axis in np.eye(z.shape[1]):
        try:
            _, label = kmeans2(white, np.stack([-axis, axis]), minit="matrix", missing="raise")
        except ClusterError:  # one of the two is empty
            continue
        first = label == 0
        if min(first.sum(), (~first).sum()) < fewest:
            continue
        within = [
            part.mean() * np.linalg.slogdet(np.atleast_2d(np.cov(z[part], rowvar=False)))[1]
            for part in (first, ~first)
        ]
        if whole - sum(within) > best:
            best, halves = whole - sum(within), first
    return halves


@dataclass(frozen=True, eq=False, kw_only=True)
class WeightedPoints(ABC):
    """Points z (s, p) with their log densities.

    The first ``priors`` points come from the prior, the next from the proposals. Points beyond
    these are added by hand: they have log densities, but do not change those of the others.

    at : the log densities of the points, (s, ...) each: a named tuple with the prior's, ``prior``.
    proposals, counts : the kernels, and the number of points from each.
    log_kernels : log density (c, s) of each proposal at each point.
    """

    z: np.ndarray
    at: Any
    priors: int
    proposals: tuple[Kernels, ...] = ()
    counts: tuple[int, ...] = ()
    log_kernels: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @abstractmethod
    def densities(self, z: np.ndarray) -> Any:
        """Return the log densities ``at`` points z (s, p)."""

    @property
    def drawn(self) -> int:
        """Number of points that come from prior and proposals."""
        return self.priors + sum(self.counts)

    @property
    def log_mixture(self) -> np.ndarray:
        """Log density (s,) of the mixture of prior and proposals."""
        shares = np.array([self.priors, *self.counts]) / self.drawn
        components = np.vstack([self.at.prior, *self.log_kernels])
        return logsumexp(components, axis=0, b=shares[:, None])

    def stepped(self, log_weights: np.ndarray, rng: np.random.Generator) -> Self:
        """Return the points with more from kernels around those of large weight."""
        chances = tempered(log_weights, min(TEMPERED_SHARE * len(self.z), MOST_TEMPERED))
        if not chances.any():
            return self
        centres = self.z[rng.choice(len(self.z), size=_RESAMPLED, p=chances)]
        # A kernel centred on a point would take that point's weight away.
        centres = Kernels.following(centres, rng).sample(rng, len(centres))
        return self.extended(Kernels.following(centres, rng), STEP, rng)

    def extended(self, proposal: Kernels, count: int, rng: np.random.Generator) -> Self:
        """Return the points with ``count`` more from ``proposal``."""
        points = self.with_points(proposal.sample(rng, count))
        return replace(
            points,
            proposals=(*points.proposals, proposal),
            counts=(*points.counts, count),
            log_kernels=np.vstack([points.log_kernels, proposal.log_density(points.z)[None]]),
        )

    def continued(self, count: int, rng: np.random.Generator) -> Self:
        """Return the points with ``count`` more from the last proposal."""
        points = self.with_points(self.proposals[-1].sample(rng, count))
        return replace(points, counts=(*self.counts[:-1], self.counts[-1] + count))

    def with_points(self, z: np.ndarray) -> Self:
        """Return the points with added ones z (s, p), which do not come from the proposals."""
        new = self.densities(z)
        return replace(
            self,
            z=np.concatenate([self.z, z]),
            at=type(self.at)(*(np.concatenate(both) for both in zip(self.at, new, strict=True))),
            log_kernels=np.hstack([self.log_kernels, self.log_kernels_at(z)]),
        )

    def log_kernels_at(self, z: np.ndarray) -> np.ndarray:
        """Return the log density (c, s) of each proposal at points z (s, p)."""
        return np.array([q.log_density(z) for q in self.proposals]).reshape(-1, len(z))


LogDensities = Callable[[np.ndarray], Any]  # z (s, p) to log densities (s,): prior, likelihood


@dataclass(frozen=True, eq=False, kw_only=True)
class PosteriorPoints(WeightedPoints):
    """Points of one posterior, with the log densities of ``log_densities``."""

    log_densities: LogDensities

    @classmethod
    def of_proposal(
        cls, proposal: Kernels, count: int, rng: np.random.Generator, log_densities: LogDensities
    ) -> Self:
        """Return ``count`` points from ``proposal``, and none from the prior."""
        z = proposal.sample(rng, count)
        return cls(
            z=z, at=log_densities(z), priors=0, proposals=(proposal,), counts=(count,),
            log_kernels=proposal.log_density(z)[None], log_densities=log_densities,
        )  # fmt: skip

    def densities(self, z: np.ndarray) -> Any:
        """Return the log densities at points z (s, p)."""
        return self.log_densities(z)

    @property
    def log_posterior(self) -> np.ndarray:
        """Log posterior density (s,) at the points, up to the evidence, their mean weight."""
        return np.asarray(self.at.prior + self.at.likelihood)

    @property
    def log_weights(self) -> np.ndarray:
        """Log weights (s,) of the posterior."""
        return self.log_posterior - self.log_mixture


def effective_number(log_weights: np.ndarray) -> float:
    """Return the effective number of points with these log weights (s,)."""
    return effective(normalised(log_weights))


def tempered(log_weights: np.ndarray, least: float) -> np.ndarray:
    """Return weights of sum 1, to the largest power up to 1 with ``least`` effective points."""
    finite = np.isfinite(log_weights)
    if effective_number(log_weights) >= least or finite.sum() <= least:
        return normalised(log_weights)
    log = log_weights[finite] - log_weights[finite].max()

    def surplus(power: float) -> float:
        return effective_number(power * log) - least

    weights = np.zeros_like(log_weights)
    weights[finite] = normalised(brentq(surplus, 0.0, 1.0, xtol=1e-12) * log)
    return weights


def resampled(weights: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return rows (count,) drawn with ``weights`` (s,) of sum 1, in random order.

    In systematic resampling each row comes as often as its weight says, up to one.
    """
    edges = np.cumsum(weights)
    at = (np.arange(count) + rng.uniform()) / count * edges[-1]
    return rng.permutation(np.minimum(np.searchsorted(edges, at), len(edges) - 1))
