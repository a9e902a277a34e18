r"""Many cheap points, weighted as draws of the mixture of all proposals that they come from.

With :math:`n_c` of :math:`M` points from proposal :math:`q_c`, every point is weighted by the
mixture (the balance heuristic; Veach and Guibas 1995, Elvira et al. 2019),

.. math:: w_i \propto \frac{\pi(z_i)}{q(z_i)}, \qquad q = \sum_c \frac{n_c}{M} q_c

so that a weight is large only where no proposal has its mass. Proposals follow the draws of a
posterior, surround them, and come from the prior. From the prior they also move to the posterior by
themselves: each step puts kernels around points resampled with weights :math:`w^\beta`, with
:math:`\beta` rising to 1 as fast as the effective number of points allows (nonlinear population
Monte Carlo; Koblents and Miguez 2015). So a mode is found that no draw ever visited.

A proposal is a mixture of Student-t kernels around points. A posterior may be a thin, bent sheet.
Its draws are straightened by a transport map of unit Jacobian (:mod:`calibrate.samplers.transport`)
so that one covariance :math:`\Sigma` describes them, and

.. math:: q_c(\zeta) = \frac1K \sum_k t_\nu(\zeta; \zeta_k, h^2 \Sigma)

is known at every point. Small widths :math:`h` follow the points, large ones surround them.

A pool evaluates the map and its correction, never FEM.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import numpy as np
from scipy.optimize import brentq
from scipy.special import gammaln, logsumexp

from calibrate.certificate.predictive import Correction, Evaluated, Predictive
from calibrate.samplers import transport
from calibrate.samplers.diagnostics import effective, normalised

_ENOUGH = 800.0  # effective points at which the pool is good
MOST_TEMPERED = 300.0  # effective points that the kernels of the next step are put on, at most
_TEMPERED_SHARE = 0.15  # that number at most, as a share of the pool's points
_FOLLOWING = 2048  # points of the proposal that follows the draws
_FREEDOM = 5.0  # degrees of freedom of the kernels
_WIDE, _WIDE_WIDTHS, _WIDE_FREEDOM = 512, (1.0, 2.0), 3.0
_PRIOR = 512
_STEP, _SEARCH_ROUNDS, _POLISH_ROUNDS = 512, 8, 4
_CENTRES = 192  # kernels of a proposal
_FITTED = 1024  # points to which the straightening is fitted
# Shares of the testing points: from the corrected posterior, from the draws' smoothed density, from
# where FEM may find the data likely, from the surroundings of the draws, and from the whole pool.
_CORRECTED, _DRAWS, _EXPLORED, _AROUND, _EVEN = 0.55, 0.15, 0.1, 0.1, 0.1


def key_from(rng: np.random.Generator) -> jax.Array:
    """Return a JAX key drawn from NumPy's generator."""
    return jax.random.key(int(rng.integers(2**31)))


@dataclass(frozen=True)
class Kernels:
    """A mixture of Student-t kernels in straightened coordinates.

    map_ : the transport map from straightened coordinates to z.
    centres : the centres (k, p), straightened.
    root : the Cholesky factor (p, p) of the covariance.
    widths : the factors h of the kernels' sd, all equally often.
    freedom : the degrees of freedom.
    """

    map_: transport.TransportMap
    centres: np.ndarray
    root: np.ndarray
    widths: tuple[float, ...]
    freedom: float

    @classmethod
    def around(
        cls, z: np.ndarray, widths: tuple[float, ...], freedom: float, rng: np.random.Generator
    ) -> Kernels:
        """Return kernels around some of the points z (s, p), with the covariance of all."""
        rows = rng.permutation(len(z))
        map_ = transport.fit(z[rows[:_FITTED]])
        straight = transport.straighten(map_, z)
        covariance = np.atleast_2d(np.cov(straight, rowvar=False))
        # A coordinate that does not vary still gets a width, so that the density exists.
        root = np.linalg.cholesky(covariance + np.diag(1e-9 * np.diag(covariance) + 1e-12))
        return cls(map_, straight[rows[:_CENTRES]], root, widths, freedom)

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

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return points z (count, p)."""
        centres = self.centres[rng.integers(len(self.centres), size=count)]
        width = rng.choice(self.widths, size=(count, 1))
        scale = width * np.sqrt(self.freedom / rng.chisquare(self.freedom, size=(count, 1)))
        straight = centres + scale * (rng.normal(size=centres.shape) @ self.root.T)
        return transport.bend(self.map_, straight)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Return log densities (s,) at points z (s, p); the map has unit Jacobian."""
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


@dataclass(frozen=True, eq=False)
class Pool:
    """Points z (s, p) with their log densities under a map and its correction.

    The first ``priors`` points come from the prior, the next from the proposals. Points beyond
    these are added by hand: they have log densities, but do not change those of the others.

    at : log prior and log likelihoods of the points, (s,) each.
    proposals, counts : the kernels, and the number of points from each.
    log_kernels : log density (c, s) of each proposal at each point.
    follower : the index of the proposal that follows the draws; the next one surrounds them.
    """

    predictive: Predictive
    correction: Correction
    z: np.ndarray
    at: Evaluated
    priors: int
    proposals: tuple[Kernels, ...] = ()
    counts: tuple[int, ...] = ()
    log_kernels: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    follower: int = 0

    @classmethod
    def search(
        cls,
        predictive: Predictive,
        correction: Correction,
        draws: np.ndarray,
        modes: tuple[np.ndarray, ...],
        rng: np.random.Generator,
    ) -> Pool:
        """Return a pool that covers the draws (s, p) of z, and where the prior leads to.

        modes : points around each further mode of FEM.
        """
        z = predictive.prior_draws(key_from(rng), _PRIOR)
        at = predictive.evaluate(z, correction)
        pool = cls(predictive, correction, z, at, _PRIOR, log_kernels=np.zeros((0, _PRIOR)))
        for _ in range(_SEARCH_ROUNDS):
            if _effective(pool.log_explored) >= _TEMPERED_SHARE * len(pool.z):
                break
            pool = pool.stepped(pool.log_explored, rng)
        pool = replace(pool, follower=len(pool.proposals))
        pool = pool.extended(Kernels.following(draws, rng), _FOLLOWING, rng)
        pool = pool.extended(Kernels.surrounding(draws, rng), _WIDE, rng)
        for points in modes:
            pool = pool.extended(Kernels.following(points, rng), _STEP, rng)
        return pool.polished(rng)

    @property
    def drawn(self) -> int:
        """Number of points that come from prior and proposals."""
        return self.priors + sum(self.counts)

    @property
    def log_mixture(self) -> np.ndarray:
        """Log density (s,) of the mixture of prior and proposals."""
        shares = np.log(np.array([self.priors, *self.counts]) / self.drawn)
        components = np.vstack([self.at.prior, *self.log_kernels])
        return logsumexp(components + shares[:, None], axis=0)

    @property
    def log_corrected(self) -> np.ndarray:
        """Log weights (s,) of the posterior with the corrected map, up to a constant."""
        return self.at.prior + self.at.corrected - self.log_mixture

    @property
    def corrected(self) -> np.ndarray:
        """Weights (s,) of sum 1 of the posterior with the corrected map."""
        return normalised(self.log_corrected)

    @property
    def log_cheap(self) -> np.ndarray:
        """Log weights (s,) of the posterior with the map alone, up to a constant."""
        return self.at.prior + self.at.cheap - self.log_mixture

    @property
    def log_explored(self) -> np.ndarray:
        """Log weights (s,) of where FEM may find the data likely, up to a constant.

        The gap of a corrected log likelihood to the best one counts :math:`1 / (1 + v)` times, with
        the correction's variance :math:`v`: as if the noise had the correction's error added.
        """
        gap = self.at.corrected - np.max(self.at.corrected[: self.drawn], initial=-1e300)
        return self.at.prior + gap / (1.0 + self.at.variance) - self.log_mixture

    @property
    def log_chances(self) -> np.ndarray:
        """Log probability (s,) of each point to be a test: a mixture of several weights."""
        # Two parts ignore what the map says, because it may be wrong, corrected or not.
        at_draws, around = self.log_kernels[self.follower : self.follower + 2] - self.log_mixture
        parts = (
            (_CORRECTED, self.log_corrected),
            (_DRAWS, at_draws),
            (_EXPLORED, self.log_explored),
            (_AROUND, around),
            (_EVEN, np.zeros(len(self.z))),
        )
        totals = [logsumexp(log[: self.drawn]) for _, log in parts]
        chances = logsumexp(
            [
                np.log(share) + log - total
                for (share, log), total in zip(parts, totals, strict=True)
                if np.isfinite(total)
            ],
            axis=0,
        )
        return chances - logsumexp(chances[: self.drawn])

    def log_tested(self, count: int) -> np.ndarray:
        r"""Return the log density (s,) of distinct tests around each point, for ``count`` tests.

        In expectation, :math:`M q (1 - e^{-n a})` with :math:`M` points of density :math:`q` and
        chances :math:`a`.
        """
        tested = -np.expm1(-count * np.exp(self.log_chances))
        return np.log(self.drawn) + self.log_mixture + np.log(tested)

    def tests(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return rows (count,) to be tested, and the log density (count,) they are drawn from."""
        log_chances = self.log_chances
        chances = np.exp(log_chances)
        rows = rng.choice(len(chances), size=count, p=chances / chances.sum())
        return rows, (self.log_mixture + log_chances)[rows]

    def resampled(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return rows (count,) as draws of the corrected map's posterior, in random order.

        In systematic resampling each row comes as often as its weight says, up to one.
        """
        edges = np.cumsum(self.corrected)
        at = (np.arange(count) + rng.uniform()) / count * edges[-1]
        return rng.permutation(np.minimum(np.searchsorted(edges, at), len(edges) - 1))

    def polished(
        self, rng: np.random.Generator, rounds: int = _POLISH_ROUNDS, *, cheap: bool = True
    ) -> Pool:
        """Return a pool with 800 effective points, corrected and, if ``cheap``, by the map alone.

        After ``rounds`` steps they may be fewer.
        """
        pool = self
        for _ in range(rounds):
            posteriors = [pool.log_corrected, pool.log_cheap] if cheap else [pool.log_corrected]
            poorest = min(posteriors, key=_effective)
            if _effective(poorest) >= _ENOUGH:
                break
            pool = pool.stepped(poorest, rng)
        return pool

    def stepped(self, log_weights: np.ndarray, rng: np.random.Generator) -> Pool:
        """Return the pool with points from kernels around points of large weight."""
        chances = tempered(log_weights, min(_TEMPERED_SHARE * len(self.z), MOST_TEMPERED))
        if not chances.any():
            return self
        centres = self.z[rng.choice(len(self.z), size=1024, p=chances)]
        # A kernel centred on a point of the pool would take its weight away.
        centres = Kernels.following(centres, rng).sample(rng, len(centres))
        return self.extended(Kernels.following(centres, rng), _STEP, rng)

    def extended(self, proposal: Kernels, count: int, rng: np.random.Generator) -> Pool:
        """Return the pool with ``count`` points from ``proposal``."""
        pool = self.with_points(proposal.sample(rng, count))
        return replace(
            pool,
            proposals=(*pool.proposals, proposal),
            counts=(*pool.counts, count),
            log_kernels=np.vstack([pool.log_kernels, proposal.log_density(pool.z)[None]]),
        )

    def with_points(self, z: np.ndarray) -> Pool:
        """Return the pool with added points z (s, p), which do not come from its proposals."""
        new = self.predictive.evaluate(z, self.correction)
        return replace(
            self,
            z=np.concatenate([self.z, z]),
            at=Evaluated(*(np.concatenate(both) for both in zip(self.at, new, strict=True))),
            log_kernels=np.hstack([self.log_kernels, self._log_kernels_at(z)]),
        )

    def redrawn(self, rng: np.random.Generator) -> Pool:
        """Return a pool of fresh points, as many from each proposal.

        Proposals were chosen by looking at points; only points drawn after the choice are
        independent draws of the mixture (Marin, Pudlo and Sedki 2019).
        """
        prior = self.predictive.prior_draws(key_from(rng), self.priors)
        fresh = [q.sample(rng, n) for q, n in zip(self.proposals, self.counts, strict=True)]
        z = np.concatenate([prior, *fresh])
        at = self.predictive.evaluate(z, self.correction)
        return replace(self, z=z, at=at, log_kernels=self._log_kernels_at(z))

    def corrected_by(self, correction: Correction) -> Pool:
        """Return the pool under another correction."""
        at = self.predictive.evaluate_again(self.z, self.at, correction)
        return replace(self, correction=correction, at=at)

    def _log_kernels_at(self, z: np.ndarray) -> np.ndarray:
        return np.array([q.log_density(z) for q in self.proposals]).reshape(-1, len(z))


def _effective(log_weights: np.ndarray) -> float:
    return effective(normalised(log_weights))


def tempered(log_weights: np.ndarray, least: float) -> np.ndarray:
    """Return weights of sum 1, to the largest power up to 1 with ``least`` effective points."""
    finite = np.isfinite(log_weights)
    if _effective(log_weights) >= least or finite.sum() <= least:
        return normalised(log_weights)
    log = log_weights[finite] - log_weights[finite].max()

    def surplus(power: float) -> float:
        return _effective(power * log) - least

    weights = np.zeros_like(log_weights)
    weights[finite] = normalised(brentq(surplus, 0.0, 1.0, xtol=1e-12) * log)
    return weights
