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
from calibrate.samplers.nuts import NUTS
from calibrate.samplers.protocol import Context
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.density import density_of, prior_draws
from emulator.core.errors import check_arguments
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
        alone = _members(model.members, data, sampler, seed, progress=progress)
    members, first = dict(model.members), as_many(alone)
    stage = second_stage(model, density, members, first, options, Context(seed, progress))
    rounds = 1
    while not stage.weighs and rounds < _MOST_ROUNDS:
        members = under_population(model, density, stage)
        later = _members(members, data, sampler, seed + rounds, progress=progress)
        context = Context(seed + rounds, progress)
        stage = second_stage(model, density, members, as_many(later), options, context)
        rounds += 1
    tree = make_tree(model, density, stage, seed)
    tree[ALONE] = tree_of_alone(first, tuple(model.shared), stage.weighed.in_use)
    tree.attrs.update(as_attributes(_provenance(model, options, how, seed, rounds)))
    return Hierarchy(tree)


def _members(
    members: Mapping[str, Model],
    data: Mapping[str, Data],
    sampler: str,
    seed: int,
    *,
    progress: bool,
) -> dict[str, dict[str, np.ndarray]]:
    """Return draws (s,) of all unknowns by member, each alone; from its prior without data."""
    by_member = {}
    for i, (member, member_model) in enumerate(members.items()):
        if member in data:
            values = {name: np.asarray(y) for name, y in data[member].items()}
            posterior = sample(
                member_model, values, sampler=sampler, seed=seed + i, progress=progress,
                predictions=False,
            )  # fmt: skip
            draws: Mapping[str, Any] = posterior.draws()
        else:
            density = density_of(member_model)
            z = prior_draws(density, jax.random.key(seed + i), DRAWS)
            draws = density.constrain(jnp.asarray(z))
        by_member[member] = {name: np.asarray(values) for name, values in draws.items()}
    return by_member


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
