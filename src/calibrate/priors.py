"""Priors over a scene's parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpyro.distributions as dist

from emulator.errors import InputError
from emulator.scenes.scene import Scene

Prior = Mapping[str, dist.Distribution]


def box_prior(scene: Scene) -> dict[str, dist.Distribution]:
    """Uniform over each parameter's range, on its scale: log-uniform where that is ``log``."""
    return {
        p.name: dist.LogUniform(p.low, p.high) if p.scale == "log" else dist.Uniform(p.low, p.high)
        for p in scene.parameters
    }


def check_prior(scene: Scene, prior: Prior) -> Prior:
    """``prior``, or :class:`InputError` unless it names exactly the scene's parameters."""
    for name in prior:
        if name not in scene.parameter_names:
            raise InputError(
                f"prior names '{name}'; scene '{scene.name}' has {', '.join(scene.parameter_names)}"
            )
    for name in scene.parameter_names:
        if name not in prior:
            raise InputError(f"prior has no distribution for parameter '{name}'")
    return prior
