"""Sets of theta in the parameter box, for training and testing."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.scenes.scene import Scene

_CORNER_EVERY = 5  # every fifth theta of a design is a corner of the box
_MOST_CORNERED = 6  # parameters; the box of more has too many corners, and none is used


def sobol(scene: Scene, count: int, seed: int) -> jax.Array:
    """``count`` theta (count, p) of a scrambled Sobol sequence over the box, on its scales."""
    _check(count, seed)
    from scipy.stats import qmc  # half a second, which a solve needs not wait for

    bits = max(count - 1, 1).bit_length()
    points = qmc.Sobol(len(scene.parameters), rng=seed).random_base2(bits)[:count]
    return scene.from_unit(jnp.asarray(points))


def latin_hypercube(scene: Scene, count: int, seed: int) -> jax.Array:
    """``count`` theta (count, p) of a Latin hypercube over the box, on its scales.

    Each parameter is spread evenly by itself; a shorter design is not part of a longer one.
    """
    _check(count, seed)
    from scipy.stats import qmc

    points = qmc.LatinHypercube(len(scene.parameters), rng=seed).random(count)
    return scene.from_unit(jnp.asarray(points))


def uniform(scene: Scene, count: int, key: jax.Array) -> jax.Array:
    """``count`` independent theta (count, p), uniform over the box on its scales."""
    return scene.from_unit(jax.random.uniform(key, (count, len(scene.parameters))))


def design(scene: Scene, count: int, seed: int) -> jax.Array:
    """``count`` theta (count, p) for FEM runs: a Sobol sequence, and with it the box's corners.

    A surrogate is worst at the corners, which a Sobol sequence does not reach (docs/experiments.md,
    "When k-hat cries wolf"). Every fifth theta is a corner, in random order, until all are used;
    with more than 6 parameters there are none. A shorter design is the beginning of a longer one.
    """
    whole = sobol(scene, count, seed)
    parameters = len(scene.parameters)
    ends = np.zeros((0, parameters))
    if parameters <= _MOST_CORNERED:
        ends = np.array(list(product((0.0, 1.0), repeat=parameters)))
        ends = np.random.default_rng(seed).permutation(ends)[: count // _CORNER_EVERY]
    inside = np.asarray(scene.to_unit(whole))
    places = _CORNER_EVERY * np.arange(1, len(ends) + 1) - 1
    positions = np.zeros((count, parameters))
    positions[places] = ends
    positions[np.setdiff1d(np.arange(count), places)] = inside[: count - len(ends)]
    return scene.from_unit(jnp.asarray(positions))


DESIGNS: dict[str, Callable[[Scene, int, int], jax.Array]] = {
    "sobol": sobol,
    "latin_hypercube": latin_hypercube,
    "sobol_corners": design,
}
"""Designs of a campaign by name; the last is the one that emulators are trained on."""


def _check(count: int, seed: int) -> None:
    if count < 1 or seed < 0:
        raise InputError(
            f"{count} samples with seed {seed} asked for; give 1 or more, seed 0 or more"
        )
