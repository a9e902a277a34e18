"""Converged FEM solutions to learn from."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.progress import counting
from emulator.fem.campaign.engine import Executor, Solver, in_process, solve_rows
from emulator.fem.campaign.memory import MemoryRows
from emulator.fem.campaign.starts import Neighbours, Predictor
from emulator.fem.simulator import Simulator


class Runs(NamedTuple):
    """Converged FEM solutions.

    theta : (c, p). displacement : (c, n, 3) mm. energy : (c,) mN mm; NaN of a scene whose mesh is
    loaded.
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

    def followed_by(self, others: Runs) -> Runs:
        """These runs and ``others``; with sensitivities where both have them."""
        slopes = None
        if self.sensitivities is not None and others.sensitivities is not None:
            slopes = jnp.concatenate([self.sensitivities, others.sensitivities])
        return Runs(
            jnp.concatenate([self.theta, others.theta]),
            jnp.concatenate([self.displacement, others.displacement]),
            jnp.concatenate([self.energy, others.energy]),
            slopes,
        )


class StoredRuns(NamedTuple):
    """Converged rows of a campaign's store. ``digest`` : short hash of which rows they are."""

    runs: Runs
    digest: str


def run_campaign(
    simulator: Simulator,
    thetas: jax.Array,
    *,
    sensitivities: bool = False,
    predictor: Predictor | None = None,
    deadline: float = np.inf,
    at_least: int = 1,
    progress: bool = False,
    execute: Executor = in_process,
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
    rows = MemoryRows(thetas)
    # The potential of a body whose mesh is loaded is that of the shape at rest, another each time.
    at_rest = not simulator.scene.loaded_by
    solver = Solver(simulator, sensitivities=sensitivities, energy=at_rest)
    solved = solve_rows(
        solver,
        thetas,
        numbers=_begun(len(thetas), deadline, at_least),
        starts=Neighbours(simulator.scene, rows, predictor),
        execute=execute,
    )
    for row in counting(solved, "FEM", total=len(thetas), disable=not progress, unit="run"):
        row.solution.require_converged(f"FEM run {row.number}")
        rows.write(row)
    found = rows.in_order()
    return Runs(
        jnp.stack([jnp.asarray(row.theta) for row in found]),
        jnp.stack([row.solution.displacement for row in found]),
        jnp.stack([row.energy for row in found]),
        jnp.stack([row.sensitivities for row in found]) if sensitivities else None,
    )


def _begun(count: int, deadline: float, at_least: int) -> Iterator[int]:
    """Numbers up to ``count``; after the deadline, up to ``at_least``."""
    for number in range(count):
        if number >= at_least and time.perf_counter() > deadline:
            return
        yield number
