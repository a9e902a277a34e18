r"""Simulation-based calibration: a check that credible intervals cover as often as they claim.

Draw :math:`\theta^* \sim p(\theta)` and data :math:`y \sim p(y \mid \theta^*)`, and sample
:math:`p(\theta \mid y)`. If model, forward map and sampler are right, :math:`\theta^*` and the L
draws are exchangeable, so the rank of any quantity :math:`f(\theta^*, y)` among
:math:`f(\theta_1, y), \dots, f(\theta_L, y)` is uniform (Talts et al. 2018). With one uniform
number V a replicate,

.. math:: u = \frac{\#\{f(\theta_l, y) < f(\theta^*, y)\}
              + V\,(1 + \#\{f(\theta_l, y) = f(\theta^*, y)\})}{L + 1}

is uniform on (0, 1) exactly, also with ties. Ranks of the parameters alone miss some errors: a
posterior equal to the prior passes. The log likelihood as a quantity depends on the data and
catches them (Modrák et al. 2023). The empirical distribution function of u is compared with bands
that hold for all of it at once (Säilynoja, Bürkner and Vehtari 2022); a central interval of
probability c covers the truth where :math:`|u - 1/2| < c / 2`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import beta

from calibrate.arviz import ecdf_utils
from calibrate.posterior import predictions
from calibrate.posterior.posterior import sample
from calibrate.statistical_model import Model
from emulator.core.display import counting
from emulator.core.engine import engine_of
from emulator.core.errors import InputError, check_seed
from emulator.fem.campaign import in_order

LOG_LIKELIHOOD = "log likelihood"
"""Name of the quantity that depends on the data."""

LEVELS = (0.5, 0.8, 0.9, 0.95)
_BAND_SIMULATIONS = 2000
_FEWEST = 20  # replicates, below which bands say nothing

Quantities = Mapping[str, np.ndarray]
"""Values by the quantity's name: () for the truth, (draws,) for a posterior."""


class Replicate(NamedTuple):
    """One simulated data set: quantities at the truth, and at draws of its posterior."""

    truth: Quantities
    draws: Quantities


class Band(NamedTuple):
    """Empirical distribution function of u at ``x`` (n,), and the ends of its simultaneous band."""

    x: np.ndarray
    ecdf: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def outside(self) -> float:
        """Largest distance by which the function leaves the band; 0 where it stays inside."""
        return float(np.max(np.maximum(self.low - self.ecdf, self.ecdf - self.high).clip(min=0.0)))


@dataclass(frozen=True)
class Calibration:
    """Ranks of many replicates; :func:`calibration_of` and :func:`sbc` make it.

    ranks : (r,) numbers u in (0, 1) by the quantity's name, uniform where all is right.
    """

    ranks: Mapping[str, np.ndarray]

    @property
    def replicates(self) -> int:
        """Number of data sets."""
        return len(next(iter(self.ranks.values())))

    def band(self, name: str, probability: float = 0.95) -> Band:
        """Return the empirical distribution function of a quantity's ranks, with its band.

        ``probability`` is that with which the whole function of a right posterior stays inside.
        """
        u = self.ranks[name]
        x = np.arange(1, len(u)) / len(u)
        pointwise = _pointwise(len(u), probability)
        return Band(
            x,
            ecdf_utils.compute_ecdf(u, x),
            *ecdf_utils.get_pointwise_confidence_band(pointwise, len(u), x),
        )

    def outside(self, probability: float = 0.95) -> dict[str, float]:
        r"""Return the distance of each quantity's function from its band, 0 inside.

        All q functions of a right posterior stay inside together with ``probability`` at least:
        each has a band of :math:`1 - (1 - \text{probability}) / q` (Bonferroni).
        """
        band_probability = 1.0 - (1.0 - probability) / len(self.ranks)
        return {name: self.band(name, band_probability).outside for name in self.ranks}

    @property
    def passed(self) -> bool:
        """Whether every function stays inside its band, at 95 % for all together."""
        return not any(self.outside().values())

    def coverage(self, probability: float = 0.95) -> dict[str, dict[float, tuple[float, ...]]]:
        """Return the fraction of central intervals that cover, with its error bounds, by quantity.

        The interval is Clopper and Pearson's, of ``probability``.
        """
        return {
            name: {level: _fraction(np.abs(u - 0.5) < 0.5 * level, probability) for level in LEVELS}
            for name, u in self.ranks.items()
        }

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON: ranks, distances from the bands, coverage."""
        names = ("covered", "low", "high")
        return {
            "replicates": self.replicates,
            "passed": self.passed,
            "outside": self.outside(),
            "coverage": {
                quantity: {
                    f"{level:g}": dict(zip(names, numbers, strict=True))
                    for level, numbers in by_level.items()
                }
                for quantity, by_level in self.coverage().items()
            },
            "ranks": {name: np.asarray(u).tolist() for name, u in self.ranks.items()},
        }


@lru_cache(maxsize=32)
def _pointwise(count: int, probability: float) -> float:
    """Return the probability of the pointwise bands that hold together with ``probability``."""
    x, rng = np.arange(1, count) / count, np.random.default_rng(0)
    return float(
        ecdf_utils.simulate_confidence_bands(count, 1, x, probability, _BAND_SIMULATIONS, rng)
    )


def _fraction(hits: np.ndarray, probability: float) -> tuple[float, float, float]:
    """Return the fraction of ``hits``, and the ends of its interval."""
    count, n, tail = int(hits.sum()), len(hits), 0.5 * (1.0 - probability)
    low = float(beta.ppf(tail, count, n - count + 1)) if count else 0.0
    high = float(beta.ppf(1.0 - tail, count + 1, n - count)) if count < n else 1.0
    return count / n, low, high


def calibration_of(replicates: Iterator[Replicate], seed: int = 0) -> Calibration:
    """Return the ranks of the truths among the draws of their posteriors.

    Raises
    ------
    InputError
        Fewer than 20 replicates, draws that are missing or not finite.
    """
    rng = np.random.default_rng(seed)
    ranks: dict[str, list[float]] = {}
    for replicate in replicates:
        for name, draws in replicate.draws.items():
            values, truth = np.asarray(draws), float(replicate.truth[name])
            if not (values.size and np.isfinite(values).all() and np.isfinite(truth)):
                raise InputError(f"calibration: a draw or truth of {name} is not finite")
            below, ties = int(np.sum(values < truth)), int(np.sum(values == truth))
            ranks.setdefault(name, []).append(
                (below + rng.random() * (1 + ties)) / (len(values) + 1)
            )
    _check_count(min(map(len, ranks.values()), default=0))
    return Calibration({name: np.array(u) for name, u in ranks.items()})


def _check_count(replicates: int) -> None:
    if replicates < _FEWEST:
        raise InputError(f"calibration: {replicates} replicates; give {_FEWEST} or more")


Draw = Mapping[str, np.ndarray]
Sample = Callable[[Draw, int], Draw]
"""Data by observation and a seed to posterior draws (s,) by the model's names, independent."""


def sbc(
    model: Model,
    replicates: int = 200,
    *,
    truth: Model | None = None,
    draws: int = 99,
    sampler: str | None = None,
    options: Any | None = None,
    seed: int = 0,
    progress: bool = False,
    draw: Sample | None = None,
    executor: Executor | str | None = None,
) -> Calibration:
    """Return the simulation-based calibration of ``model``, its forward map and a sampler.

    Parameters
    ----------
    truth : the model that makes the data: ``model`` itself by default. A model with FEM as its
        forward map tests the emulator too; one with another noise or prior must fail.
    draws : the number of draws of each posterior that are ranked, evenly spaced along the chains,
        because draws that depend on each other make the ranks too even or too extreme.
    draw : the function that draws from a posterior instead of a sampler.
    executor : the executor of :mod:`concurrent.futures`, or the words of an engine, by which
        data sets are calibrated at the same time (:mod:`emulator.core.engine`); by default one is
        after the other, and each has all cores.

    Raises
    ------
    InputError
        ``truth`` does not have the unknowns and observations of ``model``.
    """
    _check_count(replicates)
    check_seed(seed, "calibration")
    truth = model if truth is None else truth
    if (truth.names, truth.observe.shapes) != (model.names, model.observe.shapes):
        raise InputError(
            "calibration: the model that makes the data has other unknowns or observations: "
            f"{', '.join(truth.names)} instead of {', '.join(model.names)}"
        )

    data_sets = predictions.prior_replicates(truth, jax.random.key(seed), replicates)
    if (count := len(data_sets.draws[truth.names[0]])) < _FEWEST:
        raise InputError(f"calibration: {predictions.shortfall(count, replicates)[0]}")
    drawn = draw or partial(_sampled, model, draws=draws, sampler=sampler, options=options)
    ranks = _replicates(_Calibrating(model, drawn), data_sets, seed, executor, progress)
    return calibration_of(ranks, seed)


@dataclass(frozen=True)
class _Calibrating:
    """Calibrates one data set, in this process or in a worker's.

    draw : the function that draws from a posterior of ``model``.
    """

    model: Model
    draw: Sample

    def __call__(self, task: tuple[Draw, Draw, int]) -> Replicate:
        """Return a truth and draws, of the data it has made, the truth, and a seed."""
        data, truth, seed = task
        draws = self.draw(data, seed)
        return Replicate(
            {**truth, LOG_LIKELIHOOD: _log_likelihoods(self.model, truth, data)},
            {**draws, LOG_LIKELIHOOD: _log_likelihoods(self.model, draws, data)},
        )


def _sampled(
    model: Model, data: Draw, seed: int, *, draws: int, sampler: str | None, options: Any
) -> Draw:
    """Return draws (s,) of a posterior by its unknowns, evenly spaced along the chains."""
    posterior = sample(model, data, sampler=sampler, options=options, seed=seed, predictions=False)
    every = posterior.draws()
    rows = np.linspace(0, len(every[model.names[0]]) - 1, draws).astype(int)
    return {name: values[rows] for name, values in every.items()}


def _replicates(
    calibrating: _Calibrating,
    data_sets: predictions.Prior,
    seed: int,
    executor: Executor | str | None,
    progress: bool,
) -> Iterator[Replicate]:
    count = len(next(iter(data_sets.draws.values())))

    def task(r: int) -> tuple[Draw, Draw, int]:
        data, truth = (
            {name: values[r] for name, values in of.items()}
            for of in (data_sets.data, data_sets.draws)
        )
        return data, truth, seed + 1 + r  # the data sets are drawn from ``seed``

    done = in_order(calibrating, map(task, range(count)), 1, engine=engine_of(executor))
    yield from counting(done, "calibration", total=count, disable=not progress, unit="data set")


def _log_likelihoods(
    model: Model, draws: Mapping[str, Any], data: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return the log likelihood of the data at draws of any shape, in this shape."""
    shape = np.shape(draws[model.names[0]])
    table = {name: np.reshape(draws[name], (1, -1)) for name in model.names}
    terms = predictions.log_likelihood(model, table, data)
    length = table[model.names[0]].shape[1]
    rows = [v.reshape(length, -1).sum(axis=1) for v in terms.values()]
    return np.sum(rows, axis=0).reshape(shape)
