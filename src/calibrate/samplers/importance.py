r"""Adaptive importance sampling: few unknowns, and a forward map that is fast in batches.

A population begins with draws of the prior, so that it sees all of it. In every step its points are
weighted,

.. math:: w_i = \frac{p(z_i)\, L(z_i)}{q(z_i)} ,

kernels (:mod:`calibrate.samplers.proposals`) are put around points chosen with probability
proportional to :math:`w_i^\beta`, and fresh points are drawn from this next proposal :math:`q`.
The power :math:`\beta` is the largest at which a given number of points counts. With an eighth of
the points the density of a step is at most some eight times that of the one before, so that several
modes stay in, and ten steps contract it by :math:`10^9`. Points of earlier steps are let go: the
time of a step is the same at every contraction. A population that is not there after three steps
has some of its points climb the density by its gradient, and half of the next kernels are put
beside the modes they reach: near a sharp ridge tempering alone takes dozens of steps. At
:math:`\beta = 1` the proposal is fitted, twice or more, and fresh points of the last one, drawn
after it was chosen, are weighted until they are worth twice the draws asked for: :math:`n = (\sum
w_i)^2 / \sum w_i^2`. The :math:`m` draws are resampled from these points with probability
proportional to :math:`w_i`; equal ones occur. The variance of a mean of draws is that of the points
and that of the choice among them, at most :math:`\sigma^2 / n + \sigma^2 / m`: the draws are worth
two thirds of :math:`m` or more. Every weight is of the model's own density, so nothing is
approximated but by the number of points. The mean of the weights is the evidence.

Independent populations take the place of chains: their R-hat shows whether they found the same
posterior. Where they did not, because a mode is hard to find, or where a tail is heavy, each is
fitted once more to the weighted points of all. The Pareto shape of the weights' tail (Vehtari et
al. 2024) shows whether the proposal covers it.

The sampler by default, ``auto``, takes these draws where unknowns are few, the forward map is fast
in batches, populations agree and the tail is light, and those of NUTS elsewhere.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from threading import Lock
from typing import Any, ClassVar

import numpy as np
from scipy.special import logsumexp

from calibrate.samplers.density import Density, Heights, heights, prior_draws
from calibrate.samplers.diagnostics import (
    ENOUGH_ESS,
    LARGEST_PARETO_SHAPE,
    RUN_UNTIL_R_HAT,
    converged,
    normalised,
    pareto_shape,
)
from calibrate.samplers.laplace import draws_beside, find_modes
from calibrate.samplers.nuts import NUTS, NUTSOptions
from calibrate.samplers.proposals import (
    Kernels,
    effective_number,
    key_from,
    resampled,
    tempered,
)
from calibrate.samplers.protocol import Context, Draws, Options, Sampler, in_rounds
from calibrate.samplers.smc import evidence
from calibrate.statistical_model import Data
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
# Steps after which a population looks for modes by the gradient, and points that climb to them.
_PATIENCE, _CLIMBERS = 3, 8
_ONE_CLIMBS = Lock()  # at a time, so that the gradient is compiled once
_FITS, _MOST_FITS = 2, 6
_LIGHT = 0.5  # Pareto shape of the weights of a good fit: their variance is finite
_CHOSEN = 1024  # points that the kernels of a step are put around
_FITTED_TO = 4096  # points, resampled, that a proposal is fitted to
_FRESH = 2048  # points at a time from a fitted proposal
_WORTH = 2.0  # independent draws that the points are worth, for one that is resampled from them
_CENTRES, _WIDTHS, _FREEDOM = 512, (0.5, 1.0), 5.0  # of a fitted proposal
_NARROW = (0.25, 0.5)  # of a step's: wide kernels in many dimensions undo its contraction


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


@dataclass(frozen=True, eq=False)
class Population:
    """Weighted points z (s, p) of one proposal.

    at : the log prior and log likelihood of the points, (s,) each.
    log_proposal : the log density (s,) of what the points were drawn from.
    proposal : that, where it is no prior.
    """

    z: np.ndarray
    at: Heights
    log_proposal: np.ndarray
    proposal: Kernels | None = None

    @property
    def log_posterior(self) -> np.ndarray:
        """Log posterior density (s,) at the points, up to the evidence."""
        return self.at.prior + self.at.likelihood

    @property
    def log_weights(self) -> np.ndarray:
        """Log weights (s,) of the posterior."""
        return self.log_posterior - self.log_proposal

    @property
    def log_evidence(self) -> float:
        """Logarithm of the mean weight."""
        return float(logsumexp(self.log_weights) - np.log(len(self.z)))

    def and_more(self, other: Population) -> Population:
        """Return the points with others of the same proposal."""
        at = Heights(*(np.concatenate(both) for both in zip(self.at, other.at, strict=True)))
        log_proposal = np.concatenate([self.log_proposal, other.log_proposal])
        return Population(np.concatenate([self.z, other.z]), at, log_proposal, self.proposal)


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
        at = self._heights(z)
        self.points = Population(z, at, at.prior)
        if not np.isfinite(self.points.log_weights).any():
            raise SolverError("the posterior density is zero at every draw of the prior")

    def search(self) -> None:
        """Move from the prior to the posterior, and fit a proposal there."""
        for step in range(_MOST_STEPS):  # one step at least: proposals are better than the prior
            z, weights = self.points.z, tempered(self.points.log_weights, self._tempered)
            if step == _PATIENCE and weights.any():
                z, weights = self._and_modes(z, weights)
            self._go_to(z, weights, _CHOSEN, _NARROW, self._step)
            if (worth := effective_number(self.points.log_weights)) >= _FOUND:
                break
        else:
            raise SolverError(
                f"importance: the points of a population are worth {worth:.0f} draws after "
                f"{self.evaluations} evaluations; use nuts or smc"
            )
        for fits in range(1, _MOST_FITS + 1):
            self.fit(self.points.z, self.points.log_weights)
            if fits >= _FITS and pareto_shape(self.points.log_weights) < _LIGHT:
                break

    def _and_modes(self, z: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points z (s, p) and weights, half of them for draws beside the modes uphill."""
        chosen = z[resampled(weights, _CHOSEN, self._rng)]
        with _ONE_CLIMBS:
            modes = find_modes(self._density, self._data, chosen[:_CLIMBERS], chosen)
            count = _CHOSEN // _CLIMBERS
            beside = draws_beside(self._density, self._data, modes, count, self._rng)
        if not len(beside):
            return z, weights
        shares = np.full(len(beside), 1.0 / len(beside))
        return np.concatenate([z, beside]), 0.5 * np.concatenate([weights, shares])

    def fit(self, z: np.ndarray, log_weights: np.ndarray) -> None:
        """Go to fresh points from kernels around weighted points z (s, p)."""
        self._go_to(z, normalised(log_weights), _FITTED_TO, _WIDTHS, _FRESH)

    def _go_to(
        self, z: np.ndarray, weights: np.ndarray, chosen: int, widths: tuple[float, ...], count: int
    ) -> None:
        """Go to ``count`` fresh points from kernels around points z (s, p) chosen by weight."""
        if not weights.any():
            raise SolverError(
                "importance: the posterior density is zero at every point of a step; use nuts"
            )
        around = z[self._rng.choice(len(z), size=chosen, p=weights)]
        proposal = Kernels.around(around, widths, _FREEDOM, self._rng, centres=_CENTRES)
        self.points = self._drawn(proposal, count)

    def _drawn(self, proposal: Kernels, count: int) -> Population:
        z = proposal.sample(self._rng, count)
        return Population(z, self._heights(z), proposal.log_density(z), proposal)

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
            assert self.points.proposal is not None
            self.points = self.points.and_more(self._drawn(self.points.proposal, _FRESH))
        rows = resampled(normalised(self.points.log_weights), count, self._rng)
        return self.points.z[rows], self.points.log_posterior[rows]


def _largest_shape(runs: list[_Run]) -> float:
    """Return the largest Pareto shape of the weights' tail in any population."""
    return float(np.max([pareto_shape(run.points.log_weights) for run in runs]))


def _of_all(runs: list[_Run]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points z (s, p) of all populations and their log weights (s,)."""
    populations = [run.points for run in runs]
    log_weights = [points.log_weights - np.log(len(points.z)) for points in populations]
    return np.concatenate([points.z for points in populations]), np.concatenate(log_weights)


class ImportanceSampling(Sampler):
    """The sampler of adaptive importance sampling."""

    def sample(
        self, density: Density, data: Data, options: ImportanceOptions, context: Context
    ) -> Draws:
        """Return draws resampled from the weighted points of independent populations.

        The attribute ``log_evidence`` is the logarithm of the populations' mean evidence,
        ``log_evidence_error`` its standard error, ``weights_pareto_k`` the largest Pareto shape of
        a population's weights, ``evaluations`` those of the density in all, and
        ``effective_points`` the number of independent draws that all points are worth.

        Raises
        ------
        SolverError
            The density is zero wherever the prior was drawn, or a population did not come to the
            posterior within ``options.evaluations``.
        """
        # One after the other, so that programs are compiled once; each is a thread from there on.
        seeds = ([context.seed, k] for k in range(options.chains))
        runs = [_Run(density, data, options, seed) for seed in seeds]
        with (
            counting(desc=self.name, total=options.chains, disable=not context.progress) as bar,
            ThreadPoolExecutor(min(density.at_once, options.chains)) as pool,
        ):

            def search(run: _Run) -> None:
                run.search()
                bar.update()

            def draw(total: int) -> Draws:
                z, lp = zip(*pool.map(lambda run: run.draw(total), runs), strict=True)
                return Draws(np.stack(z), {"lp": np.stack(lp)})

            list(pool.map(search, runs))
            draws = draw(options.draws)
            light = _largest_shape(runs) <= LARGEST_PARETO_SHAPE
            if not (light and converged(draws.z, options.r_hat, options.ess)):
                z, log_weights = _of_all(runs)
                list(pool.map(lambda run: run.fit(z, log_weights), runs))
                draws = in_rounds(draw, options)
        attributes: dict[str, Any] = {
            "weights_pareto_k": _largest_shape(runs),
            "evaluations": int(sum(run.evaluations for run in runs)),
            "effective_points": float(sum(effective_number(r.points.log_weights) for r in runs)),
            **evidence(np.array([run.points.log_evidence for run in runs])),
        }
        return draws._replace(attributes=attributes)


IMPORTANCE: Sampler = ImportanceSampling("importance", ImportanceOptions)

MOST_UNKNOWNS = 8
# Attributes of a run of ``auto``: whose draws they are, and why not those of importance sampling.
SAMPLED_BY, NOT_BY_IMPORTANCE = "sampled_by", "not_by_importance"


@dataclass(frozen=True)
class AutoOptions(NUTSOptions):
    """Length of a run, as of NUTS; importance sampling reads its length and limits."""

    label: ClassVar[str] = "auto"


class Auto(Sampler):
    """The sampler that chooses another."""

    def sample(self, density: Density, data: Data, options: AutoOptions, context: Context) -> Draws:
        """Return the draws of the sampler named by the attribute ``sampled_by``.

        The attribute ``not_by_importance`` says why it is not importance sampling.

        Raises
        ------
        SolverError
            No chain of NUTS could start where the density is finite.
        """
        draws = _by_importance(density, data, options, context)
        if isinstance(draws, Draws):
            return draws._replace(attributes={SAMPLED_BY: IMPORTANCE.name, **draws.attributes})
        why = {SAMPLED_BY: NUTS.name, NOT_BY_IMPORTANCE: draws}
        draws = NUTS.sample(density, data, _for(NUTS, options), context)
        return draws._replace(attributes={**why, **draws.attributes})


def _by_importance(
    density: Density, data: Data, options: AutoOptions, context: Context
) -> Draws | str:
    """Return the draws of importance sampling, or why they are not to be used."""
    if density.dimension > MOST_UNKNOWNS:
        return f"{density.dimension} unknowns; up to {MOST_UNKNOWNS} are few"
    if not density.batches:
        return "the forward map solves FEM"
    try:
        draws = IMPORTANCE.sample(density, data, _for(IMPORTANCE, options), context)
    except SolverError as error:
        return str(error)
    if not (shape := draws.attributes["weights_pareto_k"]) <= LARGEST_PARETO_SHAPE:
        return f"the weights' tail is heavy, Pareto k {shape:.2f}"
    if not converged(draws.z, options.r_hat, options.ess):
        return "independent populations disagree"
    return draws


def _for(sampler: Sampler, options: AutoOptions) -> Any:
    """Return the options of a sampler that ``options`` has, too; its own defaults for others."""
    names = {field.name for field in fields(sampler.options)} & {f.name for f in fields(options)}
    return sampler.options(**{name: getattr(options, name) for name in names})


AUTO: Sampler = Auto("auto", AutoOptions)
