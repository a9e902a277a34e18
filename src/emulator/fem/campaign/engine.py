"""The loop over FEM solves, and the solve inside it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.fem.balance import relative_residual
from emulator.fem.campaign.row import Row, Task
from emulator.fem.campaign.threads import at_once, in_order
from emulator.fem.energy import potential_energy, volume_ratio
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Solution, Status

Starts = Callable[[int], Sequence[Any]]
"""Displacements (n, 3) mm that the solve of that number may start from; none for rest."""


@dataclass(frozen=True, eq=False)
class Solver:
    """Solves the tasks of a campaign. Compiled programs and the last factors are kept between them.

    Parameters
    ----------
    sensitivities : compute du/dtheta too, from each solve's own factor: a tenth of its time on a
        ventricle with five parameters.
    energy : compute the potential energy; :class:`InputError` for a scene without one.
    from_rest_again : solve a second time, from rest, where a start fails.
    """

    simulator: Simulator
    sensitivities: bool = False
    energy: bool = False
    from_rest_again: bool = True

    def __post_init__(self) -> None:
        if self.energy:
            self._energy  # noqa: B018 - a scene without one is refused before the first solve

    def __call__(self, task: Task) -> Row:
        """The row of ``task``; a solve that fails is a row with that status."""
        began, theta = time.perf_counter(), jnp.asarray(task.theta)
        solution = self.simulator.solve(theta, self._start(task.starts, theta))
        if task.starts and self.from_rest_again and not solution.converged:
            solution = self.simulator.solve(theta)
        energy = jnp.asarray(jnp.nan)
        if self.energy and solution.converged:
            energy = self._energy(solution.displacement, theta)
        solution, slopes = (
            self._with_slopes(solution, theta) if self.sensitivities else (solution, None)
        )
        return Row(task.number, theta, solution, energy, slopes, time.perf_counter() - began)

    def _with_slopes(self, solution: Solution, theta: jax.Array) -> tuple[Solution, jax.Array]:
        """The solution and du/dtheta; with a singular tangent there are no derivatives."""
        missing = jnp.full((len(theta), *solution.displacement.shape), jnp.nan)
        if not solution.converged:
            return solution, missing
        try:
            slopes = self.simulator.sensitivities(solution.displacement, theta)
            return solution, jax.block_until_ready(slopes)
        except SolverError:
            return solution._replace(status=jnp.asarray(Status.SINGULAR_TANGENT)), missing

    def _start(self, starts: Sequence[Any], theta: jax.Array) -> jax.Array | None:
        """The start with the smallest residual; None for rest.

        The last one where the shape at rest, and so the residual, is not known yet.
        """
        if self.simulator.scene.loaded_by:
            starts = starts[-1:]
        if len(starts) > 1:
            return self._best(jnp.stack([jnp.asarray(start) for start in starts]), theta)
        return jnp.asarray(starts[0]) if starts else None

    @cached_property
    def _energy(self):  # noqa: ANN202 - a compiled program, private
        return jax.jit(potential_energy(self.simulator.scene))

    @cached_property
    def _best(self):  # noqa: ANN202
        """Function that picks the start with the smallest residual among several (s, n, 3)."""
        simulator = self.simulator

        @jax.jit
        def choose(starts: jax.Array, theta: jax.Array) -> jax.Array:
            def residual(u: jax.Array) -> jax.Array:
                error = relative_residual(simulator.system, u, theta)
                sound = jnp.isfinite(error) & (jnp.min(volume_ratio(simulator.scene, u)) > 0.0)
                return jnp.where(sound, error, jnp.inf)

            return starts[jnp.argmin(jax.lax.map(residual, starts))]

        return choose


Executor = Callable[[Solver, Iterator[Task]], Iterator[Row]]
"""Solves tasks and yields rows as they are finished, taking a task when it can begin it."""


def in_process(solver: Solver, tasks: Iterator[Task]) -> Iterator[Row]:
    """The executor of this process: as many solves at once as it has cores and memory for."""
    return in_order(solver, tasks, at_once(solver.simulator))


def solve_rows(
    solver: Solver,
    thetas: Any,
    *,
    numbers: Iterable[int] | None = None,
    starts: Starts = lambda _: (),
    execute: Executor = in_process,
) -> Iterator[Row]:
    """Solve at every theta (c, p), lazily: few rows are begun that nobody has asked for.

    All loops over FEM solves are this one.

    Parameters
    ----------
    numbers : which theta, in order; all by default.
    starts : where a solve may start from; asked when the task is taken, so that it may look at the
        rows so far.
    """
    chosen = range(len(thetas)) if numbers is None else numbers
    tasks = (Task(number, thetas[number], tuple(starts(number))) for number in chosen)
    return execute(solver, tasks)


def solve_together(
    simulator: Simulator, thetas: jax.Array, starts: jax.Array | None = None
) -> Solution:
    """Solutions at every theta (c, p), whether converged or not; fields gain a leading axis.

    starts : (c, n, 3) mm, one a theta; from rest by default.
    """
    if starts is not None and len(thetas) != len(starts):
        raise InputError(f"campaign: {len(thetas)} theta, but {len(starts)} starts")
    solver = Solver(simulator, from_rest_again=False)
    one = (lambda _: ()) if starts is None else (lambda number: (starts[number],))
    solutions = [row.solution for row in solve_rows(solver, np.asarray(thetas), starts=one)]
    return jax.tree.map(lambda *fields: jnp.stack(fields), *solutions)
