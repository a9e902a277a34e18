"""Sampling of a population: each member alone, then the population from their draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.population.density import density_of_population
from calibrate.population.model import PopulationModel, population_model
from calibrate.population.posterior import ALONE, Hierarchy, make_tree, tree_of_alone
from calibrate.population.second_stage import (
    DRAWS,
    Named,
    as_many,
    second_stage,
    under_population,
)
from calibrate.posterior import sample
from calibrate.provenance import as_attributes, describe_distribution, versions
from calibrate.samplers import NUTSOptions, check_options
from calibrate.samplers.diagnostics import REFUSE_ABOVE_R_HAT, r_hat
from calibrate.samplers.nuts import NUTS
from calibrate.samplers.protocol import Context
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.density import density_of, prior_draws
from emulator.core.errors import SolverError, check_arguments
from emulator.core.machine import one_blas_thread

_MOST_ROUNDS = 3  # of members

Members = Mapping[str, tuple[Model, Any]]
"""Model and data of each member; data as :func:`calibrate.sample` takes it, or ``None``."""


def hierarchy(
    members: Members,
    *,
    options: NUTSOptions | None = None,
    alone: str = "auto",
    seed: int = 0,
    progress: bool = False,
    **population: Any,
) -> Hierarchy:
    """Calibrate members alone, then their population (:mod:`calibrate.population.second_stage`).

    Parameters
    ----------
    members : the ``(model, data)`` of each member, by name; data is ``None`` without measurements.
    options : the options of NUTS for the population.
    alone : the sampler of each member alone. The population is made of its draws, so that it
        inherits their errors: ``laplace`` is an approximation.
    population : ``shared``, ``median``, ``spread`` and ``eta`` of
        :func:`~calibrate.population.population_model`.

    Raises
    ------
    InputError
        Members that do not fit each other, data that does not fit a member, an unknown sampler or
        the options of another.
    """
    check_arguments(population, "hierarchy", hierarchy, population_model)
    checked = {
        m: (model, None) if y is None else model.given(y) for m, (model, y) in members.items()
    }
    model = population_model({m: model for m, (model, _) in checked.items()}, **population)
    data = {member: dict(y) for member, (_, y) in checked.items() if y is not None}
    return sample_population(
        model, data, options=options, alone=alone, seed=seed, progress=progress
    )


@one_blas_thread()
def sample_population(
    model: PopulationModel,
    data: Mapping[str, Data],
    *,
    options: NUTSOptions | None = None,
    alone: str | Named = "auto",
    seed: int = 0,
    progress: bool = False,
) -> Hierarchy:
    """Sample the posterior of ``model`` given ``data`` by member, which was checked before.

    Parameters
    ----------
    alone : the sampler of each member alone, or draws of each member alone.
    """
    density = density_of_population(model)
    options = check_options(NUTS, options, density.dimension)
    how, sampler = (alone, alone) if isinstance(alone, str) else ("given", "auto")
    if isinstance(alone, str):
        alone = {
            name: _draws(member, data.get(name), sampler, seed + i, progress=progress)
            for i, (name, member) in enumerate(model.members.items())
        }
    members, draws, first = dict(model.members), dict(alone), as_many(alone)
    stage = second_stage(model, density, members, first, options, Context(seed, progress))
    rounds, cheap = 1, all(density_of(member).batches for member in members.values())
    # A third round would not make the log likelihood more exact, with as many draws as the second.
    while cheap and not (stage.exact or (stage.weighs and rounds > 1)) and rounds < _MOST_ROUNDS:
        for i, (name, member) in enumerate(under_population(model, density, stage).items()):
            try:
                later = _draws(
                    member, data.get(name), sampler, seed + rounds + i, progress=progress
                )
            except SolverError:
                continue  # with its earlier draws, and a warning if they are too few
            if _agree(later):
                members[name], draws[name] = member, later
        context = Context(seed + rounds, progress)
        stage = second_stage(model, density, members, as_many(draws), options, context)
        rounds += 1
    tree = make_tree(model, density, stage, seed)
    tree[ALONE] = tree_of_alone(first, tuple(model.shared), stage.weighed.in_use)
    tree.attrs.update(as_attributes(_provenance(model, options, how, seed, rounds)))
    return Hierarchy(tree)


def _draws(
    member: Model, data: Data | None, sampler: str, seed: int, *, progress: bool
) -> dict[str, np.ndarray]:
    """Return draws (chains, s) of all unknowns of one member; without data (s,) of its prior."""
    if data is None:
        density = density_of(member)
        z = prior_draws(density, jax.random.key(seed), DRAWS)
        drawn: Mapping[str, Any] = density.constrain(jnp.asarray(z))
    else:
        values = {name: np.asarray(y) for name, y in data.items()}
        drawn = sample(
            member, values, sampler=sampler, seed=seed, progress=progress, predictions=False
        ).draws()
    return {name: np.asarray(values) for name, values in drawn.items()}


def _agree(draws: Mapping[str, np.ndarray]) -> bool:
    """Return whether chains agree; draws of a prior do."""
    return all(np.ndim(v) == 1 or r_hat(v) <= REFUSE_ABOVE_R_HAT for v in draws.values())


def _provenance(
    model: PopulationModel, options: NUTSOptions, alone: str, seed: int, rounds: int
) -> dict[str, Any]:
    """Return the priors, maps and settings behind a posterior, as plain JSON values."""
    return {
        "shared": list(model.shared),
        "prior_median": {name: describe_distribution(d) for name, d in model.median.items()},
        "prior_spread": {name: describe_distribution(d) for name, d in model.spread.items()},
        "eta": model.eta,
        "members": {
            member: {
                "scene_fingerprint": member_model.forward.scene.fingerprint,
                "forward_fingerprint": member_model.full.fingerprint,
                "prior": {name: describe_distribution(d) for name, d in member_model.prior.items()},
            }
            for member, member_model in model.members.items()
        },
        "sampler_options": asdict(options),
        "alone": alone,
        "member_rounds": rounds,
        "seed": seed,
        "versions": versions(),
    }
