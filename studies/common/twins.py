"""Data made by FEM at a known theta, with noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

import calibrate as cal
from calibrate.measurements import parse_observation
from calibrate.measurements.collection import Observations
from emulator.scenes.scene import Scene


def twin(
    scene: Scene, words: str, sd: Mapping[str, float], theta: jax.Array, u: jax.Array, seed: int
) -> tuple[Observations, dict[str, cal.GaussianNoise], dict[str, np.ndarray]]:
    """Return what is observed, its noise, and data.

    words : what is observed, as of ``--observe``. sd : the noise by the observation's name.
    theta, u : the parameters (p,), and FEM's displacement (n, 3) mm there.
    """
    observe = parse_observation(scene, words)
    exact = observe(u[None, observe.nodes], theta[None])
    rng = np.random.default_rng(seed)
    data: dict[str, Any] = {
        name: np.asarray(v) + sd[name] * rng.normal(size=v.shape) for name, v in exact.items()
    }
    return observe, {name: cal.GaussianNoise(sd[name]) for name in exact}, data
