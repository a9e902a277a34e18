"""The priors of a run: those that its scene states, and scenes as wide as they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from calibrate.priors.population import BOX, population_called
from calibrate.priors.wide import columns, completed, stated_prior, wide_prior, widened
from calibrate.project.run import Run
from calibrate.state_names import split
from calibrate.statistical_model import Model
from emulator.core.errors import InputError
from emulator.scenes.forward_problem import ForwardProblem
from emulator.surrogates import registry
from emulator.surrogates.taught import ROUNDS


def without_box(run: Run, scene: ForwardProblem) -> tuple[Run, ForwardProblem]:
    """Return the run with its prior in numbers, and the scene as wide, where no map needs a box.

    Rounds of FEM runs go where the posterior is. A map that answers anywhere needs no range of a
    parameter whose prior the scene states, unless something of the scene was learned in ranges.
    """
    anywhere = registry.forward_kind(run.forward).anywhere and not scene.learned_in_box
    if run.forward == ROUNDS.name:
        wide = wide_prior(scene, run.bounded)
    elif not anywhere or (wide := stated_prior(scene)) is None:
        return run, scene
    if (population := completed(population_called(run.prior), wide)) is None:
        return run, scene
    return replace(run, prior=asdict(population)), widened(scene, population)


def without_known(run: Run, words: str | Mapping[str, Any]) -> Run:
    """Return the run without the priors of known parameters, but those that its words named."""
    stated, population = population_called(words), population_called(run.prior)
    if population is None or population == stated:
        return run
    named = () if stated is None else stated.median
    entries = population.by_parameter
    inferred = {n: entry for n, entry in entries.items() if n not in run.known or n in named}
    prior = asdict(replace(population, **columns(inferred))) if inferred else BOX
    return replace(run, prior=prior)


def stated_priors(run: Run, model: Model) -> dict[str, dict[str, Any]]:
    """Return median, log_sd and source of the priors of unknowns that a run or its scene states."""
    population = population_called(run.prior) or stated_prior(model.forward.scene)
    inferred = {split(name)[0] for name in model.states.unknowns}
    by_parameter = {} if population is None else population.by_parameter
    return {name: entry for name, entry in by_parameter.items() if name in inferred}


def check_bounded(run: Run, scene: ForwardProblem) -> None:
    """Refuse a bounded parameter whose range follows from the prior that the scene states."""
    stated = {parameter.name for parameter in scene.parameters if parameter.prior is not None}
    for name in run.bounded:
        if split(name)[0] in stated:
            raise InputError(
                f"bounded: scene '{scene.name}' has a prior of '{name}', and no range that nature "
                "could end"
            )
