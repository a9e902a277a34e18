"""Scenes whose mesh is the loaded shape of an image: the loads that it was taken under."""

from __future__ import annotations

import copy
from types import MappingProxyType

import jax
import jax.numpy as jnp

from emulator.scenes.scene import Scene


def image_theta(scene: Scene, theta: jax.Array) -> jax.Array:
    """Theta (p,) with the loads' values in the image; as it is where the mesh is at rest."""
    values, theta = scene.resolve(theta), jnp.asarray(theta)
    for load, held_by in scene.loaded_by.items():
        theta = theta.at[scene.parameter_names.index(load)].set(values[held_by])
    return theta


def unmarked(scene: Scene) -> Scene:
    """The scene with nothing said of what its mesh is loaded by; theta stays.

    A parameter that only the image had is then nobody's, which a scene made anew would refuse.
    """
    plain = copy.copy(scene)
    object.__setattr__(plain, "loaded_by", MappingProxyType({}))
    return plain
