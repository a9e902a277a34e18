"""FEM runs over the parameter box, each started from a prediction of the earlier ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from emulator.fem.assembly import relative_residual
from emulator.fem.functional import potential_energy, volume_ratio
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene

Predictor = Callable[[jax.Array], jax.Array]
"""Maps a position in the unit box (p,) to a starting displacement (n, 3) mm."""


class Runs(NamedTuple):
    """Converged FEM solutions.

    theta : (c, p). displacement : (c, n, 3) mm. energy : (c,) mN mm.
    sensitivities : (c, p, n, 3), du/dtheta in mm per unit of each parameter; None unless requested.
    """

    theta: jax.Array
    displacement: jax.Array
    energy: jax.Array
    sensitivities: jax.Array | None = None

    def take(self, rows: slice | np.ndarray) -> Runs:
        """Some of the runs."""
        sensitivities = None if self.sensitivities is None else self.sensitivities[rows]
        return Runs(self.theta[rows], self.displacement[rows], self.energy[rows], sensitivities)


def run_campaign(
    simulator: Simulator,
    thetas: jax.Array,
    *,
    sensitivities: bool = False,
    predictor: Predictor | None = None,
    deadline: float = np.inf,
    at_least: int = 1,
    progress: bool = False,
) -> Runs:
    """Solve at every theta (c, p).

    Each run starts from the solution at the nearest theta so far, from that solution extrapolated
    along its sensitivities, or from ``predictor``: whichever has the smallest residual. If that
    start fails, the run starts again from rest.

    Parameters
    ----------
    sensitivities : compute du/dtheta too, from each run's own factor: a tenth of the run's time on
        a ventricle with five parameters.
    deadline : value of ``time.perf_counter`` after which only the first ``at_least`` runs begin.

    Raises
    ------
    SolverError
        A solve failed; the message names the run and the reason.
    """
    scene = simulator.scene
    positions = np.asarray(scene.to_unit(thetas))
    fields: list[jax.Array] = []
    found: list[jax.Array] = []  # du/dtheta
    moved: list[jax.Array] = []  # du/dx, x the position in the unit box
    best = _chooser(simulator)
    for k, theta in enumerate(tqdm(thetas, "FEM", disable=not progress, unit="run")):
        if k >= at_least and time.perf_counter() > deadline:
            break
        starts = _starts(positions[: k + 1], fields, moved, predictor)
        start = best(jnp.stack(starts), theta) if len(starts) > 1 else next(iter(starts), None)
        solution = simulator.solve(theta, start)
        if not solution.converged and starts:
            solution = simulator.solve(theta)
        fields.append(solution.require_converged(f"FEM run {k}").displacement)
        if sensitivities:
            found.append(simulator.sensitivities(fields[-1], theta))
            moved.append(scene.space.unit_sensitivities(theta[None], found[-1][None])[0])
    thetas = thetas[: len(fields)]
    displacement = jnp.stack(fields)
    energy = jax.jit(jax.vmap(potential_energy(scene)))(displacement, thetas)
    return Runs(thetas, displacement, energy, jnp.stack(found) if sensitivities else None)


def _starts(
    positions: np.ndarray,
    fields: list[jax.Array],
    derivatives: list[jax.Array],
    predictor: Predictor | None,
) -> list[jax.Array]:
    """Displacements (n, 3) to start from at the last of ``positions`` (k + 1, p)."""
    starts = []
    if fields:
        steps = positions[-1] - positions[:-1]
        near = int(np.argmin(np.sum(steps**2, axis=1)))
        starts.append(fields[near])
        if derivatives:
            starts.append(fields[near] + jnp.tensordot(steps[near], derivatives[near], axes=1))
    if predictor is not None:
        starts.append(predictor(jnp.asarray(positions[-1])))
    return starts


def _chooser(simulator: Simulator):  # noqa: ANN202 - a jitted closure, private
    """Function that picks the start with the smallest residual among several (s, n, 3)."""
    scene: Scene = simulator.scene

    @jax.jit
    def choose(starts: jax.Array, theta: jax.Array) -> jax.Array:
        def residual(u: jax.Array) -> jax.Array:
            error = relative_residual(simulator.system, u, theta)
            sound = jnp.isfinite(error) & (jnp.min(volume_ratio(scene, u)) > 0.0)
            return jnp.where(sound, error, jnp.inf)

        return starts[jnp.argmin(jax.lax.map(residual, starts))]

    return choose
