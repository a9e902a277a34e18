r"""Many points, cheaply: draws of several proposals weighted as draws of their mixture.

With :math:`n_c` points from proposal :math:`q_c`, every point is weighted by the mixture they all
come from (the balance heuristic; Veach and Guibas 1995, Elvira et al. 2019),

.. math:: w_i \propto \frac{\pi(z_i)}{q(z_i)}, \qquad q = \sum_c \frac{n_c}{M} q_c

so that no weight is large where any proposal is at home. Proposals follow the draws of a posterior,
look beyond them, and come from the prior. From the prior they also move to the posterior by
themselves: each round puts kernels around points resampled with weights :math:`w^\beta`, with
:math:`\beta` rising to 1 as fast as the weights' effective number allows (nonlinear population
Monte Carlo; Koblents and Miguez 2015). So a mode is found that no draw ever visited.

Everything here asks the map and its correction, not FEM.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from calibrate.certificate.correction import Correction
from calibrate.certificate.predictive import Evaluated, Predictive
from calibrate.certificate.proposals import Kernels, around
from calibrate.samplers.importance import effective, normalised

NEAR, NEAR_FREEDOM = 2048, 5.0
WIDE, WIDE_WIDTHS, WIDE_FREEDOM = 512, (1.0, 2.0), 3.0
PRIOR = 512
STEP, SEARCH_ROUNDS, POLISH_ROUNDS = 512, 8, 4
_TEMPERED_ESS, MOST_TEMPERED = 0.15, 300.0  # of the points, for the next round's kernels
ENOUGH = 800.0  # effective points at which the pool is good
# Shares of the points that test: from the corrected posterior, from the draws' density, smoothed,
# where FEM may find the data likely, around the draws, and from the whole pool.
_CORRECTED, _NEAR, _EXPLORED, _WIDE, _EVEN = 0.55, 0.15, 0.1, 0.1, 0.1


@dataclass(frozen=True, eq=False)
class Pool:
    """Points (s, p) with their log densities.

    proposals, counts : kernels and how many points each gave; the first ``priors`` points are the
        prior's. Points beyond those ``drawn`` are guests, which change nothing of the others.
    near : which proposal has the draws' density, smoothed; the next one surrounds them.
    log_kernels : of each proposal at each point, (c, s).
    at : log prior and likelihoods of the points, (s,) each.
    """

    z: np.ndarray
    at: Evaluated
    priors: int
    proposals: tuple[Kernels, ...] = ()
    counts: tuple[int, ...] = ()
    log_kernels: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    near: int = 0

    @property
    def drawn(self) -> int:
        """Number of points that come from the proposals."""
        return self.priors + sum(self.counts)

    @property
    def log_mixture(self) -> np.ndarray:
        """Log density (s,) of the mixture all points come from."""
        shares = np.log(np.array([self.priors, *self.counts]) / self.drawn)
        components = np.vstack([self.at.prior, *self.log_kernels])
        return logsumexp(components + shares[:, None], axis=0)

    @property
    def log_corrected(self) -> np.ndarray:
        """Log weights (s,) of the posterior with the corrected map, up to a constant."""
        return self.at.prior + self.at.corrected - self.log_mixture

    @property
    def log_explored(self) -> np.ndarray:
        """Log weights (s,) of where FEM may yet find the data likely, up to a constant.

        A corrected log likelihood below the best one counts :math:`1 / (1 + v)` of its gap, with
        the correction's variance :math:`v`: for Gaussian noise, that of a noise with the
        correction's error added.
        """
        gap = self.at.corrected - np.max(self.at.corrected[: self.drawn], initial=-1e300)
        return self.at.prior + gap / (1.0 + self.at.variance) - self.log_mixture

    @property
    def log_cheap(self) -> np.ndarray:
        """Log weights (s,) of the posterior with the map as it is, up to a constant."""
        return self.at.prior + self.at.cheap - self.log_mixture

    @property
    def log_chances(self) -> np.ndarray:
        """Log of each point's chance (s,) to test: of several weights, each by its share."""
        # Whatever a map says there: corrected or not, it may have gaps.
        near, around = self.log_kernels[self.near : self.near + 2] - self.log_mixture
        parts = (
            (_CORRECTED, self.log_corrected),
            (_NEAR, near),
            (_EXPLORED, self.log_explored),
            (_WIDE, around),
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
        r"""Log of how many points a volume of z ``count`` tests are at, around each point (s,).

        In expectation, a point that is tested again counted once:
        :math:`M q (1 - e^{-n a})` with :math:`M` points of density :math:`q` and chances :math:`a`.
        """
        tested = -np.expm1(-count * np.exp(self.log_chances))
        return np.log(self.drawn) + self.log_mixture + np.log(tested)

    @property
    def corrected(self) -> np.ndarray:
        """Weights (s,) of sum 1 of the posterior with the corrected map."""
        return normalised(self.log_corrected)


def widths(dimension: int) -> tuple[float, ...]:
    """Widths of kernels on draws, in their sd; narrow ones are needles in many dimensions."""
    return (0.15, 0.5) if dimension <= 2 else (0.35, 0.7)


def _effective(log_weights: np.ndarray) -> float:
    return effective(normalised(log_weights))


def tempered(log_weights: np.ndarray, least: float) -> np.ndarray:
    """Weights to the largest power up to 1 that leaves ``least`` effective points, of sum 1."""
    alive = np.isfinite(log_weights)
    if effective(normalised(log_weights)) >= least or alive.sum() <= least:
        return normalised(log_weights)
    log = log_weights[alive] - log_weights[alive].max()

    def gap(power: float) -> float:
        return effective(normalised(power * log)) - least

    result = np.zeros_like(log_weights)
    result[alive] = normalised(brentq(gap, 0.0, 1.0, xtol=1e-12) * log)
    return result


def search(
    predictive: Predictive,
    correction: Correction,
    draws: np.ndarray,
    ends: tuple[np.ndarray, ...],
    rng: np.random.Generator,
) -> Pool:
    """A pool that knows the draws (s, p) of z, what is beyond them, and what the prior leads to.

    ends : points around whatever else FEM finds likely.
    """
    key = jax.random.key(int(rng.integers(2**31)))
    z = predictive.prior_draws(key, PRIOR)
    pool = Pool(z, predictive.evaluate(z, correction), PRIOR, (), (), np.zeros((0, PRIOR)))
    for _ in range(SEARCH_ROUNDS):
        if _effective(pool.log_explored) >= _TEMPERED_ESS * len(pool.z):
            break
        pool = step(pool, predictive, correction, pool.log_explored, rng)
    near = around(draws, widths(draws.shape[1]), NEAR_FREEDOM, rng)
    pool = replace(pool, near=len(pool.proposals))
    pool = extend(pool, predictive, correction, near, NEAR, rng)
    pool = extend(pool, predictive, correction, around_draws(draws, rng), WIDE, rng)
    for points in ends:
        kernels = around(points, widths(draws.shape[1]), NEAR_FREEDOM, rng)
        pool = extend(pool, predictive, correction, kernels, STEP, rng)
    return polish(pool, predictive, correction, rng)


def around_draws(draws: np.ndarray, rng: np.random.Generator) -> Kernels:
    """A proposal that surrounds the draws (s, p) of z, by one and two of their sd."""
    return around(draws, WIDE_WIDTHS, WIDE_FREEDOM, rng)


def polish(
    pool: Pool, predictive: Predictive, correction: Correction, rng: np.random.Generator
) -> Pool:
    """More points until both posteriors, corrected and not, have :data:`ENOUGH` effective ones."""
    for _ in range(POLISH_ROUNDS):
        poorest = min((pool.log_corrected, pool.log_cheap), key=_effective)
        if _effective(poorest) >= ENOUGH:
            break
        pool = step(pool, predictive, correction, poorest, rng)
    return pool


def step(
    pool: Pool,
    predictive: Predictive,
    correction: Correction,
    log_weights: np.ndarray,
    rng: np.random.Generator,
) -> Pool:
    """``pool`` with :data:`STEP` more points, from kernels around points of large weight.

    Those are resampled with tempered weights.
    """
    chances = tempered(log_weights, min(_TEMPERED_ESS * len(pool.z), MOST_TEMPERED))
    if not chances.any():
        return pool
    h = widths(pool.z.shape[1])
    chosen = pool.z[rng.choice(len(pool.z), size=1024, p=chances)]
    # Moved off the pool's points: a kernel on a point of the pool would take its weight away.
    chosen = around(chosen, h, NEAR_FREEDOM, rng).sample(rng, len(chosen))
    kernels = around(chosen, h, NEAR_FREEDOM, rng)
    return extend(pool, predictive, correction, kernels, STEP, rng)


def extend(
    pool: Pool,
    predictive: Predictive,
    correction: Correction,
    proposal: Kernels,
    count: int,
    rng: np.random.Generator,
) -> Pool:
    """``pool`` with ``count`` points from ``proposal``."""
    pool = with_guests(pool, predictive, correction, proposal.sample(rng, count))
    return replace(
        pool,
        proposals=(*pool.proposals, proposal),
        counts=(*pool.counts, count),
        log_kernels=np.vstack([pool.log_kernels, proposal.log_density(pool.z)[None]]),
    )


def with_guests(pool: Pool, predictive: Predictive, correction: Correction, z: np.ndarray) -> Pool:
    """``pool`` with points ``z`` (s, p) that did not come from its proposals."""
    log_kernels = np.array([q.log_density(z) for q in pool.proposals]).reshape(-1, len(z))
    new = predictive.evaluate(z, correction)
    at = Evaluated(*(np.concatenate(both) for both in zip(pool.at, new, strict=True)))
    return replace(
        pool,
        z=np.concatenate([pool.z, z]),
        at=at,
        log_kernels=np.hstack([pool.log_kernels, log_kernels]),
    )


def redrawn(
    pool: Pool, predictive: Predictive, correction: Correction, rng: np.random.Generator
) -> Pool:
    """Fresh points from the proposals of ``pool``, as many of each.

    Proposals were chosen by looking at points; only points drawn after the choice are independent
    draws of the mixture (Marin, Pudlo and Sedki 2019).
    """
    prior = predictive.prior_draws(jax.random.key(int(rng.integers(2**31))), pool.priors)
    drawn = [q.sample(rng, n) for q, n in zip(pool.proposals, pool.counts, strict=True)]
    z = np.concatenate([prior, *drawn])
    log_kernels = np.array([q.log_density(z) for q in pool.proposals]).reshape(-1, len(z))
    return replace(pool, z=z, at=predictive.evaluate(z, correction), log_kernels=log_kernels)


def corrected_again(pool: Pool, predictive: Predictive, correction: Correction) -> Pool:
    """``pool`` under another correction."""
    return replace(pool, at=predictive.evaluate_again(pool.z, pool.at, correction))
