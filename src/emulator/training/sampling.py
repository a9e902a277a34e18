"""Where in the parameter box to train and to test."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from scipy.stats import qmc

from emulator.errors import InputError
from emulator.scenes.scene import Scene


def sobol(scene: Scene, count: int, seed: int) -> jax.Array:
    """``count`` theta (count, p) of a scrambled Sobol sequence over the box, on its scales."""
    if count < 1 or seed < 0:
        raise InputError(
            f"{count} samples with seed {seed} asked for; give 1 or more, seed 0 or more"
        )
    bits = max(count - 1, 1).bit_length()
    points = qmc.Sobol(len(scene.parameters), rng=seed).random_base2(bits)[:count]
    return scene.from_unit(jnp.asarray(points))


def uniform(scene: Scene, count: int, key: jax.Array) -> jax.Array:
    """``count`` independent theta (count, p), uniform over the box on its scales."""
    return scene.from_unit(jax.random.uniform(key, (count, len(scene.parameters))))
