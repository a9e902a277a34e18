r"""Adaptive importance sampling: few unknowns, and a forward map that is fast in batches.

A population begins with draws of the prior, so that it sees all of it, and moves to the posterior
by the steps of :mod:`calibrate.samplers.proposals`. Then a proposal :math:`q`, kernels around its
points, is fitted, twice or more, and fresh points of the last one, drawn after it was chosen, are
weighted,

.. math:: w_i = \frac{p(z_i)\, L(z_i)}{q(z_i)}

until they are worth twice the draws asked for: :math:`n = (\sum w_i)^2 / \sum w_i^2`. The
:math:`m` draws are resampled from these points with probability proportional to :math:`w_i`; equal
ones occur. The variance of a mean of draws is that of the points and that of the choice among them,
at most :math:`\sigma^2 / n + \sigma^2 / m`: the draws are worth two thirds of :math:`m` or more.
Every weight is of the model's own density, so nothing is approximated but by the number of points.
The mean of the weights is the evidence.

Independent populations take the place of chains: their R-hat shows whether they found the same
posterior. Where they did not, because a mode is hard to find, each is fitted once more to the
weighted points of all. The Pareto shape of the weights' tail (Vehtari et al. 2024) shows whether
the proposal covers it.

The sampler by default, ``auto``, takes these draws where unknowns are few, the forward map is fast
in batches, populations agree and the tail is light, and those of NUTS elsewhere.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
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
from calibrate.samplers.nuts import NUTS, NUTSOptions
from calibrate.samplers.proposals import (
    MOST_TEMPERED,
    STEP,
    Kernels,
    WeightedPoints,
    effective_number,
    key_from,
    resampled,
)
from calibrate.samplers.protocol import Context, Draws, Options, Sampler, in_rounds
from calibrate.samplers.smc import evidence
from calibrate.statistical_model import Data
from emulator.core.display import counting
from emulator.core.errors import SolverError

_PRIOR = 1024  # draws of the prior that a population begins with
_TEMPERED = 12.0  # effective points of a step, times the square of the number of unknowns
_FOUND = 200.0  # effective points from which a proposal is fitted
# Evaluations by which a population has found them, or is stuck: the time of its steps grows as
# their square (docs/experiments.md, "Populations that are stuck").
_MOST_SEARCHED = 16_000
_FITS, _MOST_FITS = 2, 6
_LIGHT = 0.5  # Pareto shape of the weights of a good fit: their variance is finite
_FITTED_TO = 4096  # points, resampled, that a proposal is fitted to
_FRESH = 2048  # points at a time from a fitted proposal
_WORTH = 2.0  # independent draws that the points are worth, for one that is resampled from them
_CENTRES, _WIDTHS, _FREEDOM = 512, (0.5, 1.0), 5.0  # of a fitted proposal


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
    evaluations: int = 100_000

    label: ClassVar[str] = "importance"


@dataclass(frozen=True, eq=False, kw_only=True)
class Population(WeightedPoints):
    """Weighted points of one population."""

    density: Density
    data: Data

    @classmethod
    def of_prior(cls, density: Density, data: Data, rng: np.random.Generator) -> Population:
        """Return draws of the prior."""
        z = prior_draws(density, key_from(rng), _PRIOR)
        return cls(
            z=z, at=heights(density, z, data), priors=_PRIOR, log_kernels=np.zeros((0, _PRIOR)),
            density=density, data=data,
        )  # fmt: skip

    def densities(self, z: np.ndarray) -> Heights:
        """Return log prior and log likelihood at points z (s, p)."""
        return heights(self.density, z, self.data)

    @property
    def most_tempered(self) -> float:
        """The largest effective number of points that the kernels of a step are put on.

        Steps contract faster with fewer; modes far apart are lost with too few.
        """
        return min(_TEMPERED * self.z.shape[1] ** 2, MOST_TEMPERED)

    @property
    def log_posterior(self) -> np.ndarray:
        """Log posterior density (s,) at the points, up to the evidence."""
        return self.at.prior + self.at.likelihood

    @property
    def log_weights(self) -> np.ndarray:
        """Log weights (s,) of the posterior."""
        return self.log_posterior - self.log_mixture

    @property
    def log_evidence(self) -> float:
        """Logarithm of the mean weight."""
        return float(logsumexp(self.log_weights) - np.log(len(self.z)))

    def refitted(
        self, z: np.ndarray, log_weights: np.ndarray, rng: np.random.Generator
    ) -> Population:
        """Return fresh points from kernels around weighted points z (s, p)."""
        rows = rng.choice(len(z), size=_FITTED_TO, p=normalised(log_weights))
        proposal = Kernels.around(z[rows], _WIDTHS, _FREEDOM, rng, centres=_CENTRES)
        none = replace(
            self, z=self.z[:0], at=Heights(*(values[:0] for values in self.at)), priors=0,
            proposals=(), counts=(), log_kernels=np.zeros((0, 0)),
        )  # fmt: skip
        return none.extended(proposal, _FRESH, rng)

    def grown(self, rng: np.random.Generator) -> Population:
        """Return the points with more of their one proposal."""
        z = self.proposals[0].sample(rng, _FRESH)
        points = self.with_points(z)
        return replace(points, counts=(self.counts[0] + len(z),))


class _Run:
    """One population: its generator, its points, and how many evaluations they took."""

    def __init__(
        self, density: Density, data: Data, options: ImportanceOptions, seed: list[int]
    ) -> None:
        self._options, self._rng = options, np.random.default_rng(seed)
        self.evaluations = _PRIOR
        self.points = Population.of_prior(density, data, self._rng)
        if not np.isfinite(self.points.log_weights).any():
            raise SolverError("the posterior density is zero at every draw of the prior")

    def search(self) -> None:
        """Move from the prior to the posterior, and fit a proposal there."""
        while True:  # one step at least: proposals are better than the prior
            self._go_to(self.points.stepped(self.points.log_weights, self._rng), STEP)
            if (worth := effective_number(self.points.log_weights)) >= _FOUND:
                break
            if self.evaluations > _MOST_SEARCHED:
                raise self._failure(worth)
        for fits in range(1, _MOST_FITS + 1):
            self.fit(self.points.z, self.points.log_weights)
            if fits >= _FITS and pareto_shape(self.points.log_weights) < _LIGHT:
                break

    def fit(self, z: np.ndarray, log_weights: np.ndarray) -> None:
        """Go to fresh points from kernels around weighted points z (s, p)."""
        self._go_to(self.points.refitted(z, log_weights, self._rng), _FRESH)

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return draws z (count, p) and their log posterior densities (count,)."""
        while effective_number(self.points.log_weights) < _WORTH * count:
            self._go_to(self.points.grown(self._rng), _FRESH)
        rows = resampled(normalised(self.points.log_weights), count, self._rng)
        return self.points.z[rows], self.points.log_posterior[rows]

    def _go_to(self, points: Population, evaluations: int) -> None:
        """Take the points, which took so many evaluations more."""
        self.points, self.evaluations = points, self.evaluations + evaluations
        if self.evaluations > self._options.evaluations:
            raise self._failure(effective_number(points.log_weights))

    def _failure(self, worth: float) -> SolverError:
        return SolverError(
            f"importance: the points of a population are worth {worth:.0f} draws after "
            f"{self.evaluations} evaluations; use nuts or smc, or allow more evaluations"
        )


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
            if not converged(draws.z, options.r_hat, options.ess):
                z, log_weights = _of_all(runs)
                list(pool.map(lambda run: run.fit(z, log_weights), runs))
                draws = in_rounds(draw, options)
        shapes = [pareto_shape(run.points.log_weights) for run in runs]
        attributes: dict[str, Any] = {
            "weights_pareto_k": float(np.max(shapes)),
            "evaluations": int(sum(run.evaluations for run in runs)),
            "effective_points": float(sum(effective_number(r.points.log_weights) for r in runs)),
            **evidence(np.array([run.points.log_evidence for run in runs])),
        }
        return draws._replace(attributes=attributes)


IMPORTANCE = ImportanceSampling("importance", ImportanceOptions, ("lp",))

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


AUTO = Auto("auto", AutoOptions, ("lp",))
