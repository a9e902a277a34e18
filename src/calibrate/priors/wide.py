"""Wide priors, those that scenes state or from ranges, and scenes as wide as they are."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, replace
from typing import Any, cast

import numpy as np

from calibrate.priors.population import Population
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.parameter_space import AT_LIMIT, SHORT_OF, LogNormal, Parameter

_LEAST_LOG_SD = float(np.log(2.0))
_OF_RANGE = "the scene's range, one sd of the logarithm to each side"
_WIDTH = 3.72  # sd to each side of a median that hold all but 2e-4 of the mass


def stated_prior(scene: ForwardProblem) -> Population | None:
    """Return the log-normals that a scene states; None where it states none."""
    return _population({p.name: p.prior for p in scene.parameters if p.prior is not None})


def wide_prior(scene: ForwardProblem, bounded: Collection[str] = ()) -> Population | None:
    """Return log-normals of the parameters above zero; None where there is none.

    They are what the scene states. A range that somebody thought possible is one sd of the
    logarithm to each side of its middle, and a factor of 2 at least. A parameter whose range is
    ``bounded`` by nature keeps it.
    """
    priors = dict[str, LogNormal]()
    for k, parameter in enumerate(scene.parameters):
        if parameter.prior is not None:
            priors[parameter.name] = parameter.prior
        elif parameter.low > 0.0 and parameter.name not in bounded:
            half = max(0.5 * float(np.log(parameter.high / parameter.low)), _LEAST_LOG_SD)
            priors[parameter.name] = LogNormal(float(scene.centre[k]), half, _OF_RANGE)
    return _population(priors)


def _population(priors: Mapping[str, LogNormal]) -> Population | None:
    return Population(**columns({n: asdict(p) for n, p in priors.items()})) if priors else None


def columns(by_parameter: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return fields of a population, the inverse of :attr:`Population.by_parameter`."""
    keys = ("median", "log_sd", "source")
    return {key: {name: entry[key] for name, entry in by_parameter.items()} for key in keys}


def completed(stated: Population | None, wide: Population | None) -> Population | None:
    """Return the population of ``stated`` parameters, and of all others that ``wide`` has."""
    if stated is None or wide is None:
        return stated or wide
    return replace(stated, **columns(wide.by_parameter | stated.by_parameter))


def widened[P: ForwardProblem](scene: P, prior: Population) -> P:
    """Return ``scene`` with ranges that hold all but 2e-4 of a prior's mass of each parameter.

    A range ends just before a limit of nature, as 1/2 is of Poisson's ratio.
    """
    parameters = list(scene.parameters)
    for k, parameter in enumerate(parameters):
        if (median := prior.median.get(parameter.name)) is not None:
            step = float(np.exp(_WIDTH * prior.log_sd[parameter.name]))
            wide = replace(parameter, low=median / step, high=median * step, scale="log")
            parameters[k] = _off_limits(parameter, scene.quantities[parameter.name], wide)
    return cast(P, replace(cast(Any, scene), parameters=tuple(parameters)))


def _off_limits(parameter: Parameter, quantity: Quantity, wide: Parameter) -> Parameter:
    """Return ``wide`` with a range that keeps off nature's limits; an end at a limit stays."""
    below, above = parameter.low - quantity.low, quantity.high - parameter.high
    near = AT_LIMIT * (parameter.high - parameter.low)
    stays = parameter.scale == "uniform" and below < near
    return replace(
        wide,
        low=parameter.low if stays else max(wide.low, parameter.low - SHORT_OF * below),
        high=parameter.high if above < near else min(wide.high, parameter.high + SHORT_OF * above),
    )
