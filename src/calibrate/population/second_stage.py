"""The second stage: the population from draws of its members, weighted by what they say.

In :func:`calibrate.population.hierarchy` members are sampled alone. Then NUTS samples the
population by the members' mixtures, and the members' draws weigh the result
(:mod:`calibrate.population.density`). If these are too few near the population to weigh it, members
are sampled again with the population as their prior, and the second stage is repeated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.importance.proposals import resampled
from calibrate.importance.weights import LARGEST_PARETO_SHAPE, effective, normalised, smoothed
from calibrate.population.density import Alone, PopulationDensity, Weighed
from calibrate.population.mixtures import likelihood_of, stacked
from calibrate.population.model import PopulationModel, from_scale, to_scale
from calibrate.priors import log_normal, truncated_normal
from calibrate.samplers import NUTSOptions
from calibrate.samplers.nuts import NUTS
from calibrate.samplers.protocol import Context, Draws
from calibrate.statistical_model import Model

DRAWS = 4000  # of a member: those of its prior, and the most that are used of its posterior
# Shares of the population's draws that count after weighing: a tail is judged where fewer than half
# do, and below a tenth weights are not used.
GOOD_SHARE, LEAST_SHARE = 0.5, 0.1
# Nats by which log likelihoods may err: a smooth error of that sd moves means by as many posterior
# sds, of which a certificate allows as many.
LARGEST_ERROR = 0.25
_LATER = 0x9E3779B9  # keeps keys apart from the sampler's
_WIDER = 1.5  # prior of members sampled again, over the population in sds

Named = Mapping[str, Mapping[str, np.ndarray]]
"""Draws (s,) of all unknowns of each member, by member and name."""


@dataclass(frozen=True)
class Stage:
    """A population and its members.

    draws : the population's draws by NUTS, from the mixtures.
    weighed : what the members' draws say of them.
    members : the members' draws that were used.
    """

    draws: Draws
    weighed: Weighed
    members: Named

    @cached_property
    def _weights(self) -> tuple[np.ndarray, float]:
        log_weight, shape = smoothed(self.weighed.log_weight)
        return normalised(log_weight), shape

    @property
    def shape(self) -> float:
        """The Pareto shape of the weights' tail; beyond 0.7 their means are not known."""
        return self._weights[1]

    @property
    def share(self) -> float:
        """The share of the draws that count after weighing."""
        return effective(self._weights[0]) / len(self._weights[0])

    @property
    def error(self) -> float:
        """The sd of the log likelihood, in nats, that the members have few draws for."""
        return float(np.sqrt(self._weights[0] @ self.weighed.variance))

    @property
    def weighs(self) -> bool:
        """True where the members' draws are enough to weigh the population's."""
        least = LEAST_SHARE if self.shape <= LARGEST_PARETO_SHAPE else GOOD_SHARE
        return self.share >= least

    @property
    def exact(self) -> bool:
        """True where they are also enough for the population's log likelihood."""
        return self.weighs and self.error <= LARGEST_ERROR

    def rows(self, seed: int) -> np.ndarray:
        """Return the rows (s,) of the draws that stand for the posterior, chain by chain.

        Rows are taken by weight within each chain; where nothing can be weighed, all stay.
        """
        chains, draws = self.draws.z.shape[:2]
        if not self.weighs:
            return np.arange(chains * draws)
        rng, by_chain = np.random.default_rng(seed), self._weights[0].reshape(chains, draws)
        taken = [np.sort(resampled(weights, draws, rng)) for weights in by_chain]
        return np.concatenate([chain * draws + rows for chain, rows in enumerate(taken)])


def second_stage(
    model: PopulationModel,
    density: PopulationDensity,
    members: Mapping[str, Model],
    draws: Named,
    options: NUTSOptions,
    context: Context,
) -> Stage:
    """Return the population from ``draws`` of the members under the priors of ``members``.

    ``draws`` are as many of each; a member without data has those of its prior.
    """
    x, log_prior, likelihoods = [], [], []
    rng, priors = np.random.default_rng(context.seed), dict[int, np.ndarray]()
    for name, member in members.items():
        shared = {k: jnp.asarray(draws[name][k]) for k in model.shared}
        if id(member) not in priors:
            key = jax.random.key(int(rng.integers(2**31)))
            priors[id(member)] = on_scales(model, member.prior_draws(key, DRAWS))
        x.append(on_scales(model, shared))
        log_prior.append(_log_prior(model, member, shared))
        likelihoods.append(likelihood_of(x[-1], log_prior[-1], priors[id(member)], rng))
    alone, mixtures = Alone(np.stack(x), np.stack(log_prior)), stacked(likelihoods)
    run = NUTS.sample(density, mixtures, options, context)
    key = jax.random.fold_in(jax.random.key(context.seed), _LATER)
    weighed = density.weigh(key, run.z.reshape(-1, density.dimension), mixtures, alone)
    return Stage(run, weighed, draws)


def under_population(
    model: PopulationModel, density: PopulationDensity, stage: Stage
) -> dict[str, Model]:
    """Return the members' models with the population that was found as their prior, but wider."""
    z = stage.draws.z.reshape(-1, density.dimension)
    population = density.constrain(jnp.asarray(z))
    scores = jax.random.normal(jax.random.key(_LATER), (len(z), len(model.shared)))
    new = on_scales(model, density.values(population, scores))
    low, middle, high = np.quantile(new, (0.16, 0.5, 0.84), axis=0)
    sds, prior = _WIDER * 0.5 * (high - low), dict[str, Any]()
    for k, (name, parameter) in enumerate(model.shared.items()):
        kind = log_normal if parameter.scale == "log" else truncated_normal
        centre = float(from_scale(parameter, middle[k]))
        prior[name] = kind(centre, float(sds[k]), parameter.low, parameter.high)
    models: dict[int, Model] = {}
    return {
        name: models.setdefault(id(member), _with_prior(member, prior))
        for name, member in model.members.items()
    }


def _with_prior(member: Model, prior: Mapping[str, Any]) -> Model:
    tied = () if member.dependence is None else member.dependence.names
    return replace(
        member,
        prior={**member.prior, **prior},
        dependence=None if set(tied) & set(prior) else member.dependence,
        boxed=member.boxed - set(prior),
    )


def as_many(draws: Named) -> dict[str, dict[str, np.ndarray]]:
    """Return as many draws (s,) of each member, evenly spaced: those of the fewest, or 4000."""
    sizes = {member: np.size(next(iter(of.values()))) for member, of in draws.items()}
    count = min(DRAWS, *sizes.values())
    rows = {member: np.linspace(0, size - 1, count).astype(int) for member, size in sizes.items()}
    return {
        member: {name: np.asarray(values).reshape(-1)[rows[member]] for name, values in of.items()}
        for member, of in draws.items()
    }


def on_scales(model: PopulationModel, draws: Mapping[str, Any]) -> np.ndarray:
    """Return draws (s, k) of the shared unknowns on their parameters' scales."""
    columns = [to_scale(parameter, draws[name]) for name, parameter in model.shared.items()]
    return np.stack([np.asarray(column) for column in columns], axis=1)


def _log_prior(model: PopulationModel, member: Model, draws: Mapping[str, jax.Array]) -> np.ndarray:
    """Return the log density (s,) of shared unknowns on their scales, from a member's prior.

    A draw of density zero, as there may be at the very end of a range, gets infinity in place of
    its logarithm, so that it has no weight.
    """

    def at(draw: dict[str, jax.Array]) -> jax.Array:
        logarithms = [n for n, parameter in model.shared.items() if parameter.scale == "log"]
        return member.log_prior(draw) + sum(jnp.log(draw[name]) for name in logarithms)

    log_density = np.asarray(jax.vmap(at)(dict(draws)))
    return np.where(np.isfinite(log_density), log_density, np.inf)
