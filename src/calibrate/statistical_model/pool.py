r"""The pool of a certificate: cheap points, weighted by the map's posterior and its corrections.

The points are those of :mod:`calibrate.importance.proposals`. Proposals follow the draws of a
posterior, surround them, and come from the prior, from which they also move to the posterior by
themselves. So a mode is found that no draw ever visited.

A pool evaluates the map and its correction, never FEM.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from calibrate.importance.proposals import (
    STEP,
    TEMPERED_SHARE,
    Kernels,
    WeightedPoints,
    effective_number,
    key_from,
    resampled,
)
from calibrate.importance.weights import normalised
from calibrate.statistical_model.predictive import Densities, Predictive
from emulator.surrogates.correction import Correction

_ENOUGH = 800.0  # effective points at which the pool is good
_FOLLOWING = 2048  # points of the proposal that follows the draws
_WIDE = 512
_PRIOR = 512
_SEARCH_ROUNDS, _POLISH_ROUNDS = 8, 4
_LARGEST_SD_ERROR = 0.03
_MOST_TIMES, _MOST_NUMBERS = 8, 60_000_000
# Shares of the testing points: from the corrected posterior, from the draws' smoothed density, from
# where FEM may find the data likely, from the surroundings of the draws, and from the whole pool.
_CORRECTED, _DRAWS, _EXPLORED, _AROUND, _EVEN = 0.55, 0.15, 0.1, 0.1, 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class Pool(WeightedPoints):
    """Points z (s, p) with their log densities under a map and its correction.

    follower : the index of the proposal that follows the draws; the next one surrounds them.
    """

    predictive: Predictive
    correction: Correction
    at: Densities
    follower: int = 0

    @classmethod
    def search(
        cls,
        predictive: Predictive,
        correction: Correction,
        draws: np.ndarray | None,
        modes: tuple[np.ndarray, ...],
        rng: np.random.Generator,
    ) -> Pool:
        """Return weighted points that cover draws z (s, p) and the modes found from prior draws.

        draws : draws of a posterior; None where there are none yet.
        modes : points around each further mode of FEM.
        """
        z = predictive.prior_draws(key_from(rng), _PRIOR)
        at = predictive.evaluate(z, correction)
        pool = cls(
            z=z, at=at, priors=_PRIOR, log_kernels=np.zeros((0, _PRIOR)),
            predictive=predictive, correction=correction,
        )  # fmt: skip
        for _ in range(_SEARCH_ROUNDS):
            if effective_number(pool.log_explored) >= TEMPERED_SHARE * len(pool.z):
                break
            pool = pool.stepped(pool.log_explored, rng)
        pool = replace(pool, follower=len(pool.proposals))
        if draws is not None:
            pool = pool.extended(Kernels.following(draws, rng), _FOLLOWING, rng)
            pool = pool.extended(Kernels.surrounding(draws, rng), _WIDE, rng)
        for points in modes:
            pool = pool.extended(Kernels.following(points, rng), STEP, rng)
        return pool.polished(rng)

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
        """Log weights (s,) that favour points where FEM may find the data likely, up to a constant.

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
        """Return rows (count,) as draws of the corrected map's posterior, in random order."""
        return resampled(self.corrected, count, rng)

    def polished(
        self, rng: np.random.Generator, rounds: int = _POLISH_ROUNDS, *, cheap: bool = True
    ) -> Pool:
        """Return a pool with 800 effective points, corrected and, if ``cheap``, by the map alone.

        After ``rounds`` steps they may be fewer.
        """
        pool = self
        for _ in range(rounds):
            posteriors = [pool.log_corrected, pool.log_cheap] if cheap else [pool.log_corrected]
            poorest = min(posteriors, key=effective_number)
            if effective_number(poorest) >= _ENOUGH:
                break
            pool = pool.stepped(poorest, rng)
        return pool

    def densities(self, z: np.ndarray) -> Densities:
        """Return log densities at points z (s, p), under this pool's correction."""
        return self.predictive.evaluate(z, self.correction)

    def redrawn(self, rng: np.random.Generator) -> Pool:
        """Return a pool of fresh points, as many from each proposal, or more of each.

        Proposals were chosen by looking at points; only points drawn after the choice are
        independent draws of the mixture (Marin, Pudlo and Sedki 2019). There are up to eight times
        as many where the pool alone would leave a posterior sd uncertain by more than 3 %, as far
        as their data fit into half a gigabyte.
        """
        pool = self._fresh(1, rng)
        most = min(_MOST_TIMES, _MOST_NUMBERS // pool.at.means.size)
        times = np.ceil((pool.sd_error / _LARGEST_SD_ERROR) ** 2)
        return pool if min(times, most) <= 1 else self._fresh(int(min(times, most)), rng)

    def _fresh(self, times: int, rng: np.random.Generator) -> Pool:
        priors, counts = times * self.priors, tuple(times * count for count in self.counts)
        prior = self.predictive.prior_draws(key_from(rng), priors)
        fresh = [q.sample(rng, n) for q, n in zip(self.proposals, counts, strict=True)]
        z = np.concatenate([prior, *fresh])
        pool = replace(self, priors=priors, counts=counts, z=z, at=self.densities(z))
        return replace(pool, log_kernels=pool.log_kernels_at(z))

    @property
    def sd_error(self) -> float:
        r"""The largest Monte Carlo error of the log sd of an unknown, on its scale.

        The delta method gives :math:`\tfrac12 \{\sum_i w_i^2 (c_i^2 / \sigma^2 - 1)^2\}^{1/2}`
        for the sd :math:`\sigma` of the corrected posterior, whose points have the weights
        :math:`w` and the distances :math:`c` to the mean.
        """
        x = self.predictive.on_scales(self.predictive.columns(self.z))
        used = self.corrected > 0.0  # far away a scale may be infinite
        x, weights = x[used], self.corrected[used]
        square = (x - weights @ x) ** 2
        variance = weights @ square
        varies = variance > 0.0
        excess = weights[:, None] * (square[:, varies] / variance[varies] - 1.0)
        return 0.5 * float(np.sqrt((excess**2).sum(axis=0)).max(initial=0.0))

    def corrected_by(self, correction: Correction) -> Pool:
        """Return the pool under another correction."""
        at = self.predictive.evaluate_again(self.z, self.at, correction)
        return replace(self, correction=correction, at=at)
