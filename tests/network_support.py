"""Small emulators for tests."""

from dataclasses import replace

import jax
import numpy as np

from emulator.surrogates import Architecture, Emulator, augment
from emulator.surrogates.network import Network, fresh
from emulator.surrogates.taylor import constant

SMALL = Architecture(steps=2, latent=8, hidden=(16, 16))


def drawn(network: Network, size=0.1) -> Network:
    """The network with all weights moved at random, so that its output is not zero."""
    leaves, structure = jax.tree.flatten(network.weights)
    rng = np.random.default_rng(2)
    leaves = [leaf + size * rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves]
    return replace(network, weights=jax.tree.unflatten(structure, leaves))


def untrained(scene, seed=0, architecture=SMALL) -> Emulator:
    """An emulator of a constant and a network with random weights."""
    offset = 0.1 * np.random.default_rng(1).normal(size=scene.held.shape)
    series = constant(np.full(len(scene.parameters), 0.5), offset)
    network = fresh(scene, augment(scene), architecture, np.array([1.0, 2.0, 3.0]), seed)
    return Emulator(scene, taylor=series, network=drawn(network))
