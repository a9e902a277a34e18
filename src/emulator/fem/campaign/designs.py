"""Sets of theta: designs in the parameter box, and test points with their reference solutions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign.campaign import run_campaign
from emulator.fem.simulator import Simulator
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene

TEST_SEED = 90_210  # separate test points: training and reduced models use small seeds
_CORNER_EVERY = 5  # every fifth theta of a design is a corner of the box
_MOST_CORNERED = 6  # parameters up to which the box's corners are used; more have too many


def sobol(scene: ForwardProblem, count: int, seed: int) -> jax.Array:
    """Return ``count`` theta (count, p) of a scrambled Sobol sequence over the box's scales."""
    qmc = _samplers(count, seed)
    bits = max(count - 1, 1).bit_length()
    points = qmc.Sobol(len(scene.parameters), rng=seed).random_base2(bits)[:count]
    return scene.from_unit(jnp.asarray(points))


def latin_hypercube(scene: Scene, count: int, seed: int) -> jax.Array:
    """Return ``count`` theta (count, p) of a Latin hypercube over the box, on its scales.

    Each parameter is spread evenly by itself; a shorter design is not part of a longer one.
    """
    points = _samplers(count, seed).LatinHypercube(len(scene.parameters), rng=seed).random(count)
    return scene.from_unit(jnp.asarray(points))


def _samplers(count: int, seed: int) -> Any:
    """Return SciPy's module of designs; refuse a design of nothing."""
    if count < 1 or seed < 0:
        raise InputError(
            f"{count} samples with seed {seed} asked for; give 1 or more, seed 0 or more"
        )
    from scipy.stats import qmc  # importing takes half a second, which a single solve does not need

    return qmc


def uniform(scene: Scene, count: int, key: jax.Array) -> jax.Array:
    """Return ``count`` independent theta (count, p), uniform over the box on its scales."""
    return scene.from_unit(jax.random.uniform(key, (count, len(scene.parameters))))


def design(scene: Scene, count: int, seed: int) -> jax.Array:
    """Return ``count`` theta (count, p) for FEM runs: a Sobol sequence and the box's corners.

    A surrogate is worst at the corners, which a Sobol sequence does not reach (docs/experiments.md,
    "When k-hat cries wolf"). Every fifth theta is a corner, in random order, until all are used;
    with more than 6 parameters there are none. A shorter design is the beginning of a longer one.
    """
    sequence = sobol(scene, count, seed)
    parameters = len(scene.parameters)
    corners = np.zeros((0, parameters))
    if parameters <= _MOST_CORNERED:
        corners = np.array(list(product((0.0, 1.0), repeat=parameters)))
        corners = np.random.default_rng(seed).permutation(corners)[: count // _CORNER_EVERY]
    unit_positions = np.asarray(scene.to_unit(sequence))
    rows = _CORNER_EVERY * np.arange(1, len(corners) + 1) - 1
    positions = np.zeros((count, parameters))
    positions[rows] = corners
    positions[np.setdiff1d(np.arange(count), rows)] = unit_positions[: count - len(corners)]
    return scene.from_unit(jnp.asarray(positions))


DESIGNS: dict[str, Callable[[Scene, int, int], jax.Array]] = {
    "sobol": sobol,
    "latin_hypercube": latin_hypercube,
    "sobol_corners": design,
}
"""Designs of a campaign by name; emulators are trained on the last."""


class Reference(NamedTuple):
    """Reference solutions to evaluate forward maps against.

    thetas : (c, p). displacement : (c, n, 3) mm. source : where the solutions come from.
    """

    thetas: jax.Array
    displacement: jax.Array
    source: str


def fem_reference(simulator: Simulator, cases: int, *, progress: bool = False) -> Reference:
    """Solve at ``cases`` theta over the box; :class:`SolverError` when one fails."""
    runs = run_campaign(simulator, sobol(simulator.scene, cases, TEST_SEED), progress=progress)
    return Reference(runs.theta, runs.displacement, "our FEM")
