"""The loop over FEM solves, each started from the solution at the nearest theta so far."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.display import counting
from emulator.fem.campaign.workers import Row, Solver, Task, many_solves
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Solution
from emulator.scenes.scene import Scene

Starts = Callable[[int], Sequence[Any]]
"""Maps the number of a theta to the displacements (n, 3) mm from which its solve may start."""

Predictor = Callable[[jax.Array], jax.Array]
"""Maps a position in the unit box (p,) to a starting displacement (n, 3) mm."""


def solve_rows(
    solver: Solver,
    thetas: Any,
    *,
    numbers: Iterable[int] | None = None,
    starts: Starts = lambda _: (),
) -> Iterator[Row]:
    """Solve at every theta (c, p), lazily: few rows are begun before they are asked for.

    Every loop over FEM solves in this package is this one.

    numbers : the positions of the theta to solve at, in order; all by default.
    starts : the function that proposes starts; it is called only when a task begins.
    """
    rows = range(len(thetas)) if numbers is None else numbers
    tasks = (Task(number, thetas[number], tuple(starts(number))) for number in rows)
    return many_solves(solver.simulator, solver, tasks)


def solve_together(simulator: Simulator, thetas: jax.Array) -> Solution:
    """Return solutions at every theta (c, p), converged or not; fields gain a leading axis."""
    rows = solve_rows(Solver(simulator), np.asarray(thetas))
    return _stacked([row.solution for row in rows])


def _stacked[Fields](rows: Sequence[Fields]) -> Fields:
    stacked: Fields = jax.tree.map(lambda *fields: jnp.stack(fields), *rows)
    return stacked


class Field(NamedTuple):
    """A converged solution: displacement (n, 3) mm, and sensitivities (p, n, 3) or None."""

    displacement: Any
    sensitivities: Any = None


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Proposes starts: the solution at the nearest theta so far, and two extrapolations.

    thetas : the theta of the whole design, (c, p).
    solutions : the converged solutions so far by the number of their theta; grows meanwhile.
    predictor : the function that proposes another start, or None.
    """

    scene: Scene
    thetas: Any
    solutions: Mapping[int, Field]
    predictor: Predictor | None = None

    def __call__(self, number: int) -> list[jax.Array]:
        """Return displacements (n, 3) mm from which the solve of that number may start.

        They are the nearest solution, the same extrapolated along its sensitivities, and the
        predictor's.
        """
        position, starts = self._positions[number], list[jax.Array]()
        numbers = list(self.solutions)
        if numbers:
            steps = position - self._positions[numbers]
            nearest = int(np.argmin(np.sum(steps**2, axis=1)))
            u, slopes = self.solutions[numbers[nearest]]
            starts.append(u)
            if slopes is not None:
                rates = self._rates[numbers[nearest]]
                starts.append(u + jnp.tensordot(steps[nearest] * rates, slopes, axes=1))
        if self.predictor is not None:
            starts.append(self.predictor(jnp.asarray(position)))
        return starts

    @cached_property
    def _positions(self) -> np.ndarray:
        return np.asarray(self.scene.to_unit(jnp.asarray(self.thetas)))

    @cached_property
    def _rates(self) -> np.ndarray:
        return np.asarray(self.scene.space.rates(jnp.asarray(self.thetas)))


class Runs(NamedTuple):
    """Converged FEM solutions.

    theta : (c, p). displacement : (c, n, 3) mm.
    energy : the potential energies, (c,) mN mm; NaN for a scene whose mesh is the loaded shape.
    sensitivities : du/dtheta (c, p, n, 3) in mm per unit of each parameter; None unless requested.
    """

    theta: jax.Array
    displacement: jax.Array
    energy: jax.Array
    sensitivities: jax.Array | None = None

    def take(self, rows: slice | np.ndarray | jax.Array) -> Runs:
        """Return some of the runs."""
        return jax.tree.map(lambda array: array[rows], self)


class StoredRuns(NamedTuple):
    """Converged rows of a campaign's store, and a short hash of which rows they are."""

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
) -> Runs:
    """Solve at every theta (c, p).

    Each run starts from the solution at the nearest theta so far, from that solution extrapolated
    along its sensitivities, or from ``predictor``: whichever has the smallest residual.

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
    # A scene whose mesh is the loaded shape has another shape at rest, and another potential, at
    # every theta.
    solver = Solver(simulator, sensitivities=sensitivities, energy=not simulator.scene.loaded_by)
    solutions: dict[int, Field] = {}

    def begins(number: int) -> bool:
        return number < at_least or time.perf_counter() <= deadline

    starts = Neighbours(simulator.scene, thetas, solutions, predictor)
    numbers = takewhile(begins, range(len(thetas)))
    results = solve_rows(solver, thetas, numbers=numbers, starts=starts)
    runs = list[Runs]()
    for row in counting(results, "FEM", total=len(thetas), disable=not progress, unit="run"):
        u = row.solution.require_converged(f"FEM run {row.number}").displacement
        runs.append(Runs(row.theta, u, row.energy, row.sensitivities))
        solutions[row.number] = Field(u, row.sensitivities)
    return _stacked(runs)
