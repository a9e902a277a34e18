"""Small emulators for tests."""

from dataclasses import replace

import jax
import numpy as np

from emulator.surrogates import Architecture, augment
from emulator.surrogates.additive import Emulator, fresh
from emulator.surrogates.taylor import constant

SMALL = Architecture(steps=2, latent=8, hidden=(16, 16))


def untrained(scene, seed=0, architecture=SMALL) -> Emulator:
    """An emulator whose last layers are drawn too, so that its output is not just the offset."""
    offset = 0.1 * np.random.default_rng(1).normal(size=scene.held.shape)
    series = constant(np.full(len(scene.parameters), 0.5), offset)
    emulator = fresh(scene, augment(scene), architecture, series, np.array([1.0, 2.0, 3.0]), seed)
    leaves, structure = jax.tree.flatten(emulator.weights)
    rng = np.random.default_rng(2)
    leaves = [leaf + 0.1 * rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves]
    return replace(emulator, weights=jax.tree.unflatten(structure, leaves))
