"""Wide priors, from the ranges that somebody thought possible, and scenes as wide as they are."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from calibrate.priors.population import BOX, Population, population_called
from emulator.scenes.finer import wider_within
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, with_mesh

_LEAST_LOG_SD = float(np.log(2.0))
_WIDTH = 3.72  # sd to each side of a median that hold all but 2e-4 of the mass


def wide_prior(scene: ForwardProblem, without: Collection[str] = ()) -> Population | None:
    """Return log-normals of the parameters above zero; None where there is none.

    A range that somebody thought possible is one sd of the logarithm to each side of its middle,
    and a factor of 2 at least.

    without : the parameters that get none, as their range is nature's or their value is known.
    """
    median, log_sd = dict[str, float](), dict[str, float]()
    for k, parameter in enumerate(scene.parameters):
        if parameter.low > 0.0 and parameter.name not in without:
            median[parameter.name] = float(scene.centre[k])
            half = 0.5 * float(np.log(parameter.high / parameter.low))
            log_sd[parameter.name] = max(half, _LEAST_LOG_SD)
    if not median:
        return None
    source = "the scene's ranges, one sd of the logarithm to each side"
    return Population(median, log_sd, source=source)


Words = str | Mapping[str, Any]
"""A run's prior, in words or numbers."""


def as_wide(prior: Words, scene: ForwardProblem, bounded: Collection[str]) -> ForwardProblem:
    """Return the scene as wide as :func:`in_numbers` of all of its parameters.

    bounded : the parameters whose range nature ends.
    """
    population = completed(population_called(prior), wide_prior(scene, bounded))
    return scene if population is None else widened(with_mesh(scene), population)


def in_numbers(
    prior: Words, scene: ForwardProblem, without: Collection[str]
) -> str | dict[str, Any]:
    """Return a run's prior in numbers, wide where it states none, of a ``scene`` not yet widened.

    without : the parameters that have none, unless it is stated.
    """
    population = completed(population_called(prior), wide_prior(scene, without))
    return BOX if population is None else asdict(population)


def completed(stated: Population | None, wide: Population | None) -> Population | None:
    """Return the population of ``stated`` parameters, and of all others that ``wide`` has."""
    if stated is None or wide is None:
        return stated or wide
    return replace(stated, median=wide.median | stated.median, log_sd=wide.log_sd | stated.log_sd)


def widened(scene: Scene, prior: Population) -> Scene:
    """Return ``scene`` with ranges that hold all but 2e-4 of a prior's mass of each parameter.

    A range ends just before a limit of nature, as 1/2 is of Poisson's ratio.
    """
    parameters = list(scene.parameters)
    for k, parameter in enumerate(parameters):
        if (median := prior.median.get(parameter.name)) is not None:
            step = float(np.exp(_WIDTH * prior.log_sd[parameter.name]))
            wide = replace(parameter, low=median / step, high=median * step, scale="log")
            parameters[k] = wider_within(parameter, scene.quantities[parameter.name], wide)
    return replace(scene, parameters=tuple(parameters))
