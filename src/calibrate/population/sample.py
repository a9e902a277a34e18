"""Sampling of a population: each member alone, then population and members together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.population.density import (
    Conditions,
    Information,
    density_of_population,
    information_of,
)
from calibrate.population.model import PopulationModel, population_model, to_scale
from calibrate.population.posterior import ALONE, Hierarchy, make_tree, tree_of_alone
from calibrate.posterior import sample
from calibrate.provenance import as_attributes, describe_distribution, versions
from calibrate.samplers import NUTSOptions, check_options
from calibrate.samplers.nuts import NUTS
from calibrate.samplers.protocol import Context
from calibrate.statistical_model import Data, Model
from emulator.core.checkpoint import Checkpoint, identity_of
from emulator.core.errors import check_arguments
from emulator.core.machine import one_blas_thread

_PRIOR_DRAWS = 2000
# The spread of few members may be near 0, where steps have to be short (docs/experiments.md,
# "Members of one population").
TARGET_ACCEPT = 0.98
_NEW, _OF_PRIOR = 0x9E3779B9, 0x85EBCA6B  # keep these keys apart from the sampler's

Alone = Mapping[str, Mapping[str, np.ndarray]]
"""Draws (s,) of the shared unknowns, by member and name."""

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
    """Calibrate the members of a population together (:mod:`calibrate.population.model`).

    Parameters
    ----------
    members : the ``(model, data)`` of each member, by name; data is ``None`` without measurements.
    options : the options of NUTS for all members together; by default its own, with target_accept
        0.98.
    alone : the sampler of each member alone, for comparison and for good coordinates; ``laplace``
        is cheap and as good for the latter.
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
    alone: str | Alone = "auto",
    seed: int = 0,
    progress: bool = False,
    checkpoint: str | Path | None = None,
) -> Hierarchy:
    """Sample the posterior of ``model`` given ``data`` by member, which was checked before.

    Parameters
    ----------
    alone : the sampler of each member alone, or draws of each member alone.
    checkpoint : the file of the run's state, as of :func:`calibrate.sample`.
    """
    options = options or NUTSOptions(target_accept=TARGET_ACCEPT)
    density = density_of_population(model)
    options = check_options(NUTS, options, density.dimension)
    if isinstance(alone, str):
        by_member, sampler = _alone(model, data, alone, seed, progress=progress), alone
    else:
        by_member, sampler = {m: dict(alone[m]) for m in model.members}, "given"
    information = _information(model, by_member, data)
    provenance = _provenance(model, options, sampler, seed)
    arrays = {
        f"{kind} {member} {name}": values
        for kind, members in (("data", data), ("alone", by_member))
        for member, named in members.items()
        for name, values in named.items()
    }
    state = Checkpoint(checkpoint, identity_of(provenance, arrays))
    conditions = Conditions(dict(data), information)
    draws = NUTS.sample(density, conditions, options, Context(seed, progress, state))
    key = jax.random.fold_in(jax.random.key(seed), _NEW)
    flat = jnp.asarray(draws.z).reshape(-1, density.dimension)
    values = density.constrain(flat, information)
    tree = make_tree(model, values, draws.z.shape[:2], draws.statistics, key)
    tree[ALONE] = tree_of_alone(by_member)
    tree.attrs.update(as_attributes(provenance))
    state.remove()
    return Hierarchy(tree)


def _alone(
    model: PopulationModel, data: Mapping[str, Data], sampler: str, seed: int, *, progress: bool
) -> dict[str, dict[str, np.ndarray]]:
    """Return draws (s,) of shared unknowns by member, each alone; from its prior without data."""
    by_member = {}
    for i, (member, member_model) in enumerate(model.members.items()):
        if member in data:
            values = {name: np.asarray(y) for name, y in data[member].items()}
            posterior = sample(
                member_model, values, sampler=sampler, seed=seed + i, progress=progress,
                predictions=False,
            )  # fmt: skip
            draws: Mapping[str, Any] = posterior.draws()
        else:
            draws = member_model.prior_draws(jax.random.key(seed + i), _PRIOR_DRAWS)
        by_member[member] = {name: np.asarray(draws[name]) for name in model.shared}
    return by_member


def _information(
    model: PopulationModel, alone: Mapping[str, Mapping[str, np.ndarray]], data: Mapping[str, Data]
) -> Information:
    """Return the information of each member's data, from its posterior alone and its prior."""
    rows, priors = [], {}
    for member, member_model in model.members.items():
        draws = _on_scales(model, alone[member])
        if member in data and id(member_model) not in priors:
            key = jax.random.fold_in(jax.random.key(0), _OF_PRIOR)
            prior_draws = member_model.prior_draws(key, _PRIOR_DRAWS)
            priors[id(member_model)] = _on_scales(model, prior_draws)
        rows.append(information_of(draws, priors[id(member_model)] if member in data else draws))
    return Information(*(jnp.stack(column) for column in zip(*rows, strict=True)))


def _on_scales(model: PopulationModel, draws: Mapping[str, Any]) -> np.ndarray:
    """Return draws (s, k) of the shared unknowns on their parameters' scales."""
    columns = [to_scale(parameter, draws[name]) for name, parameter in model.shared.items()]
    return np.stack([np.asarray(column) for column in columns], axis=1)


def _provenance(
    model: PopulationModel, options: NUTSOptions, alone: str, seed: int
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
        "seed": seed,
        "versions": versions(),
    }
