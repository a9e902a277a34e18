"""FEM runs over the parameter box, each started from the nearest one already done."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from emulator.fem import Simulator
from emulator.mechanics.energy import potential_energy


class Runs(NamedTuple):
    """Converged FEM solutions: theta (c, p), displacement (c, n, 3) mm, energy (c,) mN mm."""

    theta: jax.Array
    displacement: jax.Array
    energy: jax.Array


def run_campaign(simulator: Simulator, thetas: jax.Array, *, progress: bool = False) -> Runs:
    """Solve at every theta (c, p).

    Raises
    ------
    SolverError
        A solve failed; the message says which and how.
    """
    scene = simulator.scene
    positions = np.asarray(scene.to_unit(thetas))
    fields: list[jax.Array] = []
    for k, theta in enumerate(tqdm(thetas, "FEM", disable=not progress, unit="run")):
        start = None
        if fields:
            start = fields[int(np.argmin(np.sum((positions[:k] - positions[k]) ** 2, axis=1)))]
        solution = simulator.solve(theta, start)
        fields.append(solution.require_converged(f"FEM run {k}").displacement)
    displacement = jnp.stack(fields)
    energy = jax.jit(jax.vmap(potential_energy(scene)))(displacement, thetas)
    return Runs(thetas, displacement, energy)
