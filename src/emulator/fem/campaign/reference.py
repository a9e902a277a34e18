"""Reference solutions to evaluate forward maps against, inside and outside the box."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.progress import counting
from emulator.fem.campaign import Neighbours, Solver, run_campaign, solve_rows
from emulator.fem.campaign.designs import sobol
from emulator.fem.campaign.memory import MemoryRows
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene

SEED = 90_210  # separate test points: training and reduced models use small seeds


class Reference(NamedTuple):
    """Theta (c, p), displacement (c, n, 3) mm, its source, and the number of failed solves."""

    thetas: jax.Array
    displacement: jax.Array
    source: str
    failed: int = 0


def fem_reference(simulator: Simulator, cases: int, *, progress: bool = False) -> Reference:
    """Our FEM at ``cases`` theta over the box; :class:`SolverError` when one fails."""
    runs = run_campaign(simulator, sobol(simulator.scene, cases, SEED), progress=progress)
    return Reference(runs.theta, runs.displacement, "our FEM")


def sample_outside(scene: Scene, cases: int, fraction: float) -> jax.Array:
    """Theta (cases, p) outside the box, in the box widened by ``fraction`` of each side, both ways.

    Widened on each parameter's scale; theta that law or loads do not admit are left out.
    """
    if not 0.0 < fraction < np.inf:
        raise InputError(f"outside is {fraction}; give a fraction above 0, e.g. 0.25")
    count = 2 * cases
    for _ in range(12):
        position = scene.to_unit(sobol(scene, count, SEED + 1))
        thetas = scene.from_unit(position * (1.0 + 2.0 * fraction) - fraction)
        outside = ~np.asarray(scene.space.contains(thetas))
        admitted = outside & _admissible(scene, np.asarray(thetas))
        if admitted.sum() >= cases:
            return thetas[np.flatnonzero(admitted)[:cases]]
        count *= 2
    raise InputError(f"outside {fraction:g}: next to nothing there is a value the scene takes")


def _admissible(scene: Scene, thetas: np.ndarray) -> np.ndarray:
    """Whether law, loads and regions admit every entry of each theta (c, p), (c,) bool."""
    quantities = [scene.quantities[name] for name in scene.parameter_names]
    return np.array(
        [
            all(q.value_fault(float(v)) is None for q, v in zip(quantities, theta, strict=True))
            for theta in thetas
        ]
    )


def outside_reference(
    simulator: Simulator,
    cases: int,
    fraction: float,
    inside: Reference,
    *,
    progress: bool = False,
) -> Reference:
    """Our FEM outside the box, each run started from the nearest solution, or else from rest.

    Runs that do not converge are left out and counted.
    """
    scene = simulator.scene
    thetas = sample_outside(scene, cases, fraction)
    known = len(inside.thetas)
    rows = MemoryRows(jnp.concatenate([inside.thetas, thetas]))
    for number, field in enumerate(inside.displacement):
        rows.know(number, field)
    numbers = range(known, known + cases)
    starts = Neighbours(scene, rows)
    found = solve_rows(Solver(simulator), rows.thetas, numbers=numbers, starts=starts)
    for row in counting(found, "FEM outside", total=cases, disable=not progress, unit="run"):
        rows.write(row)
    solved = [number for number in numbers if number in rows.converged()]
    fields = [rows.field(number).displacement for number in solved]
    displacement = jnp.stack(fields) if solved else jnp.zeros((0, *scene.held.shape))
    return Reference(
        rows.thetas[np.array(solved, int)], displacement, "our FEM", cases - len(solved)
    )
