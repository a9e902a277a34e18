r"""Adaptive importance sampling: few unknowns, and a forward map that is fast in batches.

A population begins with draws of the prior, so that it sees all of it. In every step its points are
weighted,

.. math:: w_i = \frac{p(z_i)\, L(z_i)}{q(z_i)} ,

kernels (:mod:`calibrate.importance.proposals`) are put around points chosen with probability
proportional to :math:`w_i^\beta`, and fresh points are drawn from this next proposal :math:`q`.
The power :math:`\beta` is the largest at which a given number of points counts. With an eighth of
the points the density of a step is at most some eight times that of the one before, so that several
modes stay in, and ten steps contract it by :math:`10^9`. Points of earlier steps are let go: the
time of a step is the same at every contraction.

Shares of modes drift from step to step, and a light mode may die. So some points of the prior and
of the first steps climb the density by its gradient (:mod:`calibrate.samplers.modes`), and kernels
are put at the modes they reach, half of all on the way and a quarter in a fit. Near a sharp ridge,
where tempering alone takes dozens of steps, that is also the shorter way.

At :math:`\beta = 1` the proposal is fitted, twice or more, and fresh points of the last one, drawn
after it was chosen, are weighted until they are worth twice the draws asked for: :math:`n = (\sum
w_i)^2 / \sum w_i^2`. The :math:`m` draws are resampled from these points with probability
proportional to :math:`w_i`; equal ones occur. The variance of a mean of draws is that of the points
and that of the choice among them, at most :math:`\sigma^2 / n + \sigma^2 / m`: the draws are worth
two thirds of :math:`m` or more. Every weight is of the model's own density, so nothing is
approximated but by the number of points. The mean of the weights is the evidence.

Independent populations take the place of chains: their R-hat shows whether they found the same
posterior. While a heavy mode was seen by one of them only, or reached by a few climbs, others may
be unseen, and more populations search, up to twelve; what is then still likely to be unseen is
told. Where not all saw all modes, or where a tail is heavy, each is fitted once more to the
weighted points of all, and at the modes of all. The Pareto shape of the weights' tail (Vehtari et
al. 2024) shows whether the proposal covers it.

A mode that has no basin to climb from is found by nothing: a spike beside a broad mode, narrower
than the distance between points of the prior.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from calibrate.importance.proposals import (
    Group,
    Kernels,
    PosteriorPoints,
    effective_number,
    key_from,
    resampled,
    tempered,
)
from calibrate.importance.weights import LARGEST_PARETO_SHAPE, normalised, pareto_shape
from calibrate.samplers.diagnostics import ENOUGH_ESS, RUN_UNTIL_R_HAT, converged
from calibrate.samplers.modes import (
    MOST,
    Mode,
    explore,
    heavy,
    merged,
    missed_mode,
    of_account,
    programs_of,
    shares,
    unseen,
)
from calibrate.samplers.protocol import Context, Draws, Options, Sampler, in_rounds
from calibrate.statistical_model import Data
from calibrate.statistical_model.density import Density, Heights, heights, prior_draws
from emulator.core.display import counting
from emulator.core.errors import SolverError

# Effective points that the kernels of a step are put on: with more, modes far apart stay in, with
# few unknowns fewer are enough (docs/experiments.md, "Why tempering stood still").
_TEMPERED, _MOST_TEMPERED = 12.0, 300.0  # times the square of the number of unknowns, and at most
_STEP = 8.0  # points of a step, for one of these
_FEWEST = 512  # points of a step
_PRIOR = 2.0  # draws of the prior, for one point of a step
_FOUND = 200.0  # effective points from which a proposal is fitted
_MOST_STEPS = 25
_PATIENCE = 3  # steps after which a population looks for modes by the gradient
# Attributes of a run: modes that one population alone saw, and the number that none may have seen.
SEEN_ONCE, UNSEEN = "modes_seen_once", "modes_unseen"
_FITS, _MOST_FITS = 2, 6
_LIGHT = 0.5  # Pareto shape of the weights of a good fit: their variance is finite
_CHOSEN = 1024  # points that the kernels of a step are put around
_FITTED_TO = 4096  # points, resampled, that a proposal is fitted to
_FRESH = 4096  # points at a time from a fitted proposal
_WORTH = 2.0  # independent draws that the points are worth, for one that is resampled from them
_CENTRES, _WIDTHS, _FREEDOM = 512, (0.5, 1.0), 5.0  # of a fitted proposal
_NARROW = (0.25, 0.5)  # of a step's: wide kernels in many dimensions undo its contraction
_WIDE = 0.5  # share of the kernels of a fit around points of the density's fourth root
_ON_THE_WAY, _IN_A_FIT = 0.5, 0.25  # share of the kernels that are put beside modes
_AT_MODE = 1.2  # width of the wider kernels at a mode, over its sd
_FEWEST_CENTRES = 8  # kernels at a mode
_MOST_FRESH = 4.0  # times the usual number of points where modes are many
_MOST_POPULATIONS = 12
_REACHED = 5  # climbs that end at each heavy mode where the look for modes was thorough
_HOLDS = 0.2  # share of its mass from which points hold a mode


@dataclass(frozen=True)
class ImportanceOptions(Options):
    """Size of a run.

    draws : the number of draws of a population, in a round.
    chains : the number of independent populations.
    rounds : the largest number of rounds; another one begins while R-hat or ESS miss their limits.
    r_hat, ess : the largest R-hat, and smallest bulk and tail ESS of any parameter, to stop at.
    evaluations : the largest number of evaluations of the density by a population.
    """

    draws: int = 1000
    chains: int = 4
    rounds: int = 8
    r_hat: float = RUN_UNTIL_R_HAT
    ess: float = ENOUGH_ESS
    evaluations: int = 200_000

    label: ClassVar[str] = "importance"


class _Run:
    """One population: its generator, its points, and how many evaluations they took."""

    def __init__(
        self, density: Density, data: Data, options: ImportanceOptions, seed: list[int]
    ) -> None:
        self._density, self._data = density, data
        self._options, self._rng, self.evaluations = options, np.random.default_rng(seed), 0
        self._tempered = min(_TEMPERED * density.dimension**2, _MOST_TEMPERED)
        self._step = max(round(_STEP * self._tempered), _FEWEST)
        z = prior_draws(density, key_from(self._rng), round(_PRIOR * self._step))
        self.points = PosteriorPoints(
            z=z, at=self._heights(z), priors=len(z), log_densities=self._heights
        )
        if not np.isfinite(self.points.log_weights).any():
            raise SolverError("the posterior density is zero at every draw of the prior")
        self.modes: list[Mode] = []
        # Half of all climbs start at draws of the prior, where each mode still has its basin.
        self._starts = [z[self._rng.choice(len(z), size=MOST)]]

    def search(self) -> None:
        """Move from the prior to the posterior, and fit a proposal there."""
        looked = False
        for step in range(_MOST_STEPS):  # one step at least: proposals are better than the prior
            z, weights = self.points.z, tempered(self.points.log_weights, self._tempered)
            if weights.any():
                self._starts.append(z[self._rng.choice(len(z), size=MOST, p=weights)])
                if step == _PATIENCE:
                    self._look()
                    looked = True
            self._go_to(z, weights, _CHOSEN, _NARROW, self._step, _ON_THE_WAY)
            if (worth := effective_number(self.points.log_weights)) >= _FOUND:
                break
        else:
            raise SolverError(
                f"importance: the points of a population are worth {worth:.0f} draws after "
                f"{self.evaluations} evaluations; use nuts or smc"
            )
        if not looked:
            self._look()
        self.settle()

    def _look(self) -> None:
        """Find modes by climbs from draws of the prior and from points of the steps, in turn."""
        prior, *steps = self._starts
        of_steps = np.stack(steps, axis=1).reshape(-1, self._density.dimension)[:MOST]
        starts = np.stack([prior, of_steps], axis=1).reshape(-1, self._density.dimension)[:MOST]
        with programs_of(self._density).climbing:
            self.modes = explore(self._density, self._data, starts, self._starts[-1])

    def settle(self) -> None:
        """Fit the proposal to the points until their weights have a light tail."""
        for fits in range(1, _MOST_FITS + 1):
            self.fit(self.points.z, self.points.log_weights, self.points.log_posterior)
            if fits >= _FITS and pareto_shape(self.points.log_weights) < _LIGHT:
                break

    def fit(self, z: np.ndarray, log_weights: np.ndarray, log_posterior: np.ndarray) -> None:
        """Go to fresh points from kernels around weighted points z (s, p).

        Half of the kernels are around points of the density's fourth root, whose tails are longer:
        a thin tail is not lost from one fit to the next.
        """
        modes = of_account(self.modes)
        beside = _IN_A_FIT if len(modes) > 1 else 0.0
        fresh = round(_FRESH * min(_MOST_FRESH, 1.0 + 0.25 * max(len(modes) - 1, 0)))
        wide = normalised(log_weights - 0.75 * np.maximum(log_posterior, -1e300))
        weights = (1.0 - _WIDE) * normalised(log_weights) + _WIDE * wide
        self._go_to(z, weights / weights.sum(), _FITTED_TO, _WIDTHS, fresh, beside)

    def _go_to(
        self,
        z: np.ndarray,
        weights: np.ndarray,
        chosen: int,
        widths: tuple[float, ...],
        count: int,
        beside: float,
    ) -> None:
        """Go to ``count`` fresh points from kernels around points z (s, p) chosen by weight.

        beside : the share of the kernels that are put beside modes, if there are any.
        """
        if not weights.any():
            raise SolverError(
                "importance: the posterior density is zero at every point of a step; use nuts"
            )
        around = z[self._rng.choice(len(z), size=chosen, p=weights)]
        proposal = self._kernels(around, widths, beside)
        self.points = PosteriorPoints.of_proposal(proposal, count, self._rng, self._heights)

    def _kernels(self, around: np.ndarray, widths: tuple[float, ...], beside: float) -> Kernels:
        """Return kernels around points (s, p), those nearest to each mode apart, and at modes.

        No mode has fewer kernels than a quarter of an equal share: light ones stay in.
        """
        modes = of_account(self.modes) if beside else []
        if not modes:
            return Kernels.around(around, widths, _FREEDOM, self._rng, centres=_CENTRES)
        nearest = np.argmin([mode.distances(around) for mode in modes], axis=0)
        numbers = np.bincount(nearest, minlength=len(modes)) / len(around)
        numbers = _CENTRES * (1.0 - beside) * np.maximum(numbers, 0.25 / len(modes))
        few, groups = 4 * (around.shape[1] + 1), list[Group]()
        for k, mode in enumerate(modes):
            part, centres = around[nearest == k], max(round(numbers[k]), _FEWEST_CENTRES)
            if len(part) >= few:
                kernels = Kernels.around(part, widths, _FREEDOM, self._rng, centres=centres)
                groups += kernels.groups
            centres = max(round(_CENTRES * beside / len(modes)), _FEWEST_CENTRES)
            groups.append(Group.at_mode(mode.z, _AT_MODE / max(widths) * mode.root, centres))
        return Kernels(tuple(groups), widths, _FREEDOM)

    def sees(self, mode: Mode, share: float) -> bool:
        """Return whether a climb of this population ended at a mode, or its points hold it.

        share : the share of the mode in the mass of all.
        """
        if any(peak.is_at(mode.z, mode.height) for peak in self.modes):
            return True
        inside = mode.distances(self.points.z) < len(mode.z) + 4.0 * np.sqrt(2.0 * len(mode.z))
        return float(normalised(self.points.log_weights)[inside].sum()) > _HOLDS * share

    def _heights(self, z: np.ndarray) -> Heights:
        """Return log densities, which count as evaluations."""
        self.evaluations += len(z)
        if self.evaluations > self._options.evaluations:
            raise SolverError(
                f"importance: {self._options.evaluations} evaluations of a population are not "
                "enough; use nuts or smc, or allow more evaluations"
            )
        return heights(self._density, z, self._data)

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return draws z (count, p) and their log posterior densities (count,)."""
        while effective_number(self.points.log_weights) < _WORTH * count:
            self.points = self.points.continued(_FRESH, self._rng)
        rows = resampled(normalised(self.points.log_weights), count, self._rng)
        return self.points.z[rows], self.points.log_posterior[rows]


def _largest_shape(runs: list[_Run]) -> float:
    """Return the largest Pareto shape of the weights' tail in any population."""
    return float(np.max([pareto_shape(run.points.log_weights) for run in runs]))


def _of_all(runs: list[_Run]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points z (s, p) of all populations, log weights and log posterior densities (s,)."""
    populations = [run.points for run in runs]
    log_weights = [points.log_weights - np.log(len(points.z)) for points in populations]
    log_posterior = np.concatenate([points.log_posterior for points in populations])
    z = np.concatenate([points.z for points in populations])
    return z, np.concatenate(log_weights), log_posterior


def _evidence(populations: list[PosteriorPoints]) -> dict[str, float]:
    r"""Return attributes: the log of the mean evidence of populations, and its standard error.

    The variance of a mean weight is told by the weights, :math:`1 / n - 1 / s` of the square for
    :math:`s` points that are worth :math:`n`, and by how the populations differ; the larger counts.
    """
    sums = [np.logaddexp.reduce(points.log_weights) for points in populations]
    logarithms = np.array(sums) - np.log([len(points.z) for points in populations])
    shifted, count = np.exp(logarithms - logarithms.max()), len(logarithms)
    mean = shifted.mean()
    within = [
        (z / mean) ** 2 * (1.0 / effective_number(points.log_weights) - 1.0 / len(points.z))
        for z, points in zip(shifted, populations, strict=True)
    ]
    between = shifted.var(ddof=1) / mean**2 if count > 1 else 0.0
    error = np.sqrt(max(np.mean(within), between) / count)
    return {
        "log_evidence": float(logarithms.max() + np.log(mean)),
        "log_evidence_error": float(error),
    }


class ImportanceSampling(Sampler):
    """The sampler of adaptive importance sampling."""

    def sample(
        self, density: Density, data: Data, options: ImportanceOptions, context: Context
    ) -> Draws:
        """Return draws resampled from the weighted points of independent populations.

        The attribute ``log_evidence`` is the logarithm of the populations' mean evidence,
        ``log_evidence_error`` its standard error, ``weights_pareto_k`` the largest Pareto shape of
        a population's weights, ``evaluations`` those of the density in all, and
        ``effective_points`` the number of independent draws that all points are worth. ``modes`` is
        the number of heavy modes, ``modes_seen_once`` that of those which one population alone
        saw, and ``modes_unseen`` an estimate of the number that none did.

        Raises
        ------
        SolverError
            The density is zero wherever the prior was drawn, or a population did not come to the
            posterior within ``options.evaluations``.
        """
        runs, modes, counts = list[_Run](), list[Mode](), list[int]()
        with (
            counting(desc=self.name, total=options.chains, disable=not context.progress) as bar,
            ThreadPoolExecutor(min(density.at_once, options.chains)) as pool,
        ):

            def search(run: _Run) -> None:
                run.search()
                bar.update()

            def draw(total: int) -> Draws:
                drawn = pool.map(lambda run: run.draw(total), runs[: options.chains])
                z, lp = zip(*drawn, strict=True)
                return Draws(np.stack(z), {"lp": np.stack(lp)})

            # One is made after the other, so that programs are compiled once.
            while not runs or (
                len(runs) < _MOST_POPULATIONS
                and (1 in counts or any(mode.climbs < _REACHED for mode in heavy(modes)))
            ):
                last = len(runs) + (2 if runs else options.chains)
                seeds = ([context.seed, k] for k in range(len(runs), last))
                new = [_Run(density, data, options, seed) for seed in seeds]
                list(pool.map(search, new))
                runs += new
                modes = merged(mode for run in runs for mode in run.modes)
                part = dict(zip(range(len(modes)), shares(modes), strict=True))
                counts = [
                    sum(run.sees(mode, part[k]) for run in runs)
                    for k, mode in enumerate(heavy(modes))
                ]
            draws = draw(options.draws)
            complete = all(count == len(runs) for count in counts)
            light = _largest_shape(runs) <= LARGEST_PARETO_SHAPE
            if not (complete and light and converged(draws.z, options.r_hat, options.ess)):
                points = _of_all(runs)

                def fit(run: _Run) -> None:
                    run.modes = modes
                    run.fit(*points)
                    run.settle()

                list(pool.map(fit, runs))
                draws = in_rounds(draw, options)
        attributes: dict[str, Any] = {
            "weights_pareto_k": _largest_shape(runs),
            "evaluations": int(sum(run.evaluations for run in runs)),
            "effective_points": float(sum(effective_number(r.points.log_weights) for r in runs)),
            "modes": len(counts),
            SEEN_ONCE: counts.count(1),
            UNSEEN: unseen(counts),
            **_evidence([run.points for run in runs]),
        }
        attributes |= missed_mode(density, data, draws.z.reshape(-1, density.dimension), modes)
        return draws._replace(attributes=attributes)


IMPORTANCE: Sampler = ImportanceSampling("importance", ImportanceOptions)
