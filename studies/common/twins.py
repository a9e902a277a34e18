"""Data made by FEM at a known theta, with noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

import calibrate as cal
import emulator as em


def twin(
    scene: em.Scene, words: str, sd: Mapping[str, float], theta: jax.Array, u: jax.Array, seed: int
) -> tuple[cal.Observations, dict[str, cal.GaussianNoise], dict[str, np.ndarray]]:
    """Return what is observed, its noise, and data.

    words : what is observed, as of ``--observe``. sd : the noise by the observation's name.
    theta, u : the parameters (p,), and FEM's displacement (n, 3) mm there.
    """
    observe = cal.parse_observation(scene, words)
    exact = observe(u[None, observe.nodes], theta[None])
    rng = np.random.default_rng(seed)
    data: dict[str, Any] = {
        name: np.asarray(v) + sd[name] * rng.normal(size=v.shape) for name, v in exact.items()
    }
    return observe, {name: cal.GaussianNoise(sd[name]) for name in exact}, data


def spread_nodes(scene: em.Scene, count: int, seed: int) -> np.ndarray:
    """Return ``count`` nodes with a free component, drawn without replacement, sorted."""
    free = np.flatnonzero(~scene.held.all(axis=1))
    return np.sort(np.random.default_rng(seed).choice(free, count, replace=False))


def wide_theta(scene: em.Scene, rng: np.random.Generator) -> dict[str, float]:
    """Return a draw of the wide prior by name.

    A parameter above zero is log-normal, one sd or a factor of 2 to an end of its range, and 2 %
    short of nature's end, as of Poisson's ratio; others fill their range.
    """
    drawn = {}
    for k, parameter in enumerate(scene.parameters):
        if parameter.low > 0.0:
            width = max(0.5 * np.log(parameter.high / parameter.low), np.log(2.0))
            value, end = np.inf, 0.98 * scene.quantities[parameter.name].high
            while value >= end:
                value = float(scene.centre[k] * np.exp(width * rng.normal()))
            drawn[parameter.name] = value
        else:
            drawn[parameter.name] = float(rng.uniform(parameter.low, parameter.high))
    return drawn
