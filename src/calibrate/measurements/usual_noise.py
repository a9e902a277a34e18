"""The default noise of observations."""

from __future__ import annotations

import jax.numpy as jnp

from calibrate.measurements.observation import Observation
from calibrate.measurements.words import names_of
from calibrate.noise.gaussian import GaussianNoise
from emulator.core.errors import InputError
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import with_mesh

LARGEST_SHARE = 0.03
"""Largest default sd of noise as a share of the body's size, or of the cavity's volume."""


def usual_noise(part: Observation, scene: ForwardProblem | None = None) -> GaussianNoise:
    """Return noise of the usual sd, in ``scene`` no larger than a share of :func:`size_in`.

    :class:`InputError` for an observation that has no usual sd.
    """
    if part.usual_sd is None:
        name = names_of(part)[0]
        raise InputError(f"{name} has no usual noise; give --noise {name}=SD, in {part.unit}")
    size = None if scene is None else size_in(part, scene)
    if size is None or part.usual_sd <= LARGEST_SHARE * size:
        return GaussianNoise(sd=part.usual_sd)
    return GaussianNoise(sd=float(f"{LARGEST_SHARE * size:.2g}"))


def size_in(part: Observation, scene: ForwardProblem) -> float | None:
    """Return the size of the body in mm, of the observed cavity at rest in mL, or None."""
    if part.unit == "mm":
        return with_mesh(scene).mesh.size
    if part.unit == "mL":
        return float(part(jnp.zeros((len(part.nodes), 3)), scene.centre))
    return None
