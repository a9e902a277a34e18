"""Wide priors, from the ranges that somebody thought possible, and scenes as wide as they are."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from calibrate.priors.population import Population
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene

_LEAST_LOG_SD = float(np.log(2.0))
_WIDTH = 3.72  # sd to each side of a median that hold all but 2e-4 of the mass


def wide_prior(scene: ForwardProblem, bounded: Collection[str] = ()) -> Population | None:
    """Return log-normals of the parameters above zero; None where there is none.

    A range that somebody thought possible is one sd of the logarithm to each side of its middle,
    and a factor of 2 at least. A parameter whose range is ``bounded`` by nature keeps it.
    """
    median, log_sd = dict[str, float](), dict[str, float]()
    for k, parameter in enumerate(scene.parameters):
        if parameter.low > 0.0 and parameter.name not in bounded:
            median[parameter.name] = float(scene.centre[k])
            half = 0.5 * float(np.log(parameter.high / parameter.low))
            log_sd[parameter.name] = max(half, _LEAST_LOG_SD)
    if not median:
        return None
    source = "the scene's ranges, one sd of the logarithm to each side"
    return Population(median, log_sd, source=source)


def completed(stated: Population | None, wide: Population | None) -> Population | None:
    """Return the population of ``stated`` parameters, and of all others that ``wide`` has."""
    if stated is None or wide is None:
        return stated or wide
    return replace(stated, median=wide.median | stated.median, log_sd=wide.log_sd | stated.log_sd)


def widened(scene: Scene, prior: Population) -> Scene:
    """Return ``scene`` with ranges that hold all but 2e-4 of a prior's mass of each parameter."""

    def range_of(name: str) -> tuple[float, float]:
        step = float(np.exp(_WIDTH * prior.log_sd[name]))
        return prior.median[name] / step, prior.median[name] * step

    parameters = []
    for parameter in scene.parameters:
        if parameter.name in prior.median:
            low, high = range_of(parameter.name)
            parameter = replace(parameter, low=low, high=high, scale="log")
        parameters.append(parameter)
    return replace(scene, parameters=tuple(parameters))
