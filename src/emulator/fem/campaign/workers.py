"""One solve of a campaign, and the threads, or the engine, that do many.

A solve is one compiled program, which does not hold Python's lock, and CHOLMOD's factorisation uses
one core. Two solves on two cores take 0.56 of the time of one after the other on a ventricle of
4627 nodes, 0.61 at 33 605 (docs/experiments.md, "Two solves at once").
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.engine import Engine
from emulator.core.errors import SolverError
from emulator.core.machine import cores, inherited, memory
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled
from emulator.fem.energy import potential_energy
from emulator.fem.linear.suitesparse import keeping_factors
from emulator.fem.simulator import Simulator
from emulator.fem.solution import EquilibriumSolver, Solution, Status
from emulator.scenes.scene import with_mesh

_BYTES_A_NODE = 100_000  # memory of a concurrent solve; 54 000 measured at 33 605 nodes
_MEMORY_SHARE = 0.5  # share of the machine's memory that solves may take


# ---- one solve -----------------------------------------------------------------------------------
class Task(NamedTuple):
    """One solve to do.

    number : the position of theta in its design. theta : (p,).
    starts : the displacements (n, 3) mm to choose a start from; empty for the start at rest.
    """

    number: int
    theta: Any
    starts: tuple[Any, ...] = ()


class Row(NamedTuple):
    """The result of one solve.

    number : the position of theta in its design. theta : (p,).
    energy : the potential energy, mN mm; NaN unless requested and converged.
    sensitivities : (p, n, 3), du/dtheta in mm per unit of each parameter, NaN where not converged;
        None unless requested.
    seconds : the wall time.
    """

    number: int
    theta: Any
    solution: Solution
    energy: Any
    sensitivities: Any
    seconds: float

    @property
    def converged(self) -> bool:
        """Whether the solve converged."""
        return bool(self.solution.converged)

    def as_numpy(self) -> Row:
        """Return the row with NumPy arrays, to store."""
        return jax.tree.map(np.asarray, self)._replace(number=self.number, seconds=self.seconds)


@dataclass(frozen=True, eq=False)
class Solver:
    """Solves the tasks of a campaign; compiled programs and the last factors are kept between them.

    sensitivities : compute du/dtheta too, from each solve's own factor: a tenth of its time on a
        ventricle with five parameters.
    energy : compute the potential energy; :class:`InputError` for a scene without one.
    """

    simulator: EquilibriumSolver
    sensitivities: bool = False
    energy: bool = False

    def __post_init__(self) -> None:
        if self.energy:
            self._energy  # noqa: B018 - a scene without one is refused before the first solve

    def __call__(self, task: Task) -> Row:
        """Return the row of ``task``; a solve that fails is a row with that status."""
        began, theta = time.perf_counter(), jnp.asarray(task.theta)
        solution = self.simulator.solve(theta, self._start(task.starts, theta))
        energy = jnp.asarray(jnp.nan)
        if self.energy and solution.converged:
            energy = self._energy(solution.displacement, theta)
        slopes = None
        if self.sensitivities:
            slopes = jnp.full((len(theta), *solution.displacement.shape), jnp.nan)
            try:
                if solution.converged:
                    slopes = self.simulator.sensitivities(solution.displacement, theta)
            except SolverError:  # a singular tangent is a failed solve
                solution = solution._replace(status=jnp.asarray(Status.SINGULAR_TANGENT))
            jax.block_until_ready(slopes)
        return Row(task.number, theta, solution, energy, slopes, time.perf_counter() - began)

    def _start(self, starts: Sequence[Any], theta: jax.Array) -> jax.Array | None:
        """Return the start with the smallest residual; None for the start at rest.

        The last start where the shape at rest, and so the residual, is not known yet.
        """
        if self.simulator.scene.loaded_by:
            starts = starts[-1:]
        if len(starts) > 1:
            assert isinstance(self.simulator, Simulator)
            system = self.simulator.system
            errors = [float(_imbalance(system, jnp.asarray(u), theta)) for u in starts]
            starts = [starts[int(np.argmin(errors))]]
        return jnp.asarray(starts[0]) if starts else None

    @cached_property
    def _energy(self):  # noqa: ANN202 - a compiled program, private
        return jax.jit(potential_energy(with_mesh(self.simulator.scene)))


@compiled
def _imbalance(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Return the relative residual () of a start (n, 3) mm, infinite where it is not valid."""
    error = system.relative_residual(u, theta)
    valid = jnp.isfinite(error) & (system.least_volume_ratio(u) > 0.0)
    return jnp.where(valid, error, jnp.inf)


# ---- many solves ---------------------------------------------------------------------------------
def at_once(simulator: EquilibriumSolver, nodes: int | None = None) -> int:
    """Return the number of concurrent solves, limited by the machine's cores and memory.

    It is 1 on large meshes, where a factor is kept between solves, and
    for a simulator of another class: only FEM simulators of this package are known to be
    thread-safe.

    nodes : the number of nodes of the mesh that is solved on; by default the simulator's.
    """
    steps = getattr(simulator, "steps", simulator)  # what goes through a history
    if not isinstance(steps, Simulator) or cast(Any, simulator).stepwise:
        return 1
    bytes_per_solve = _BYTES_A_NODE * (nodes or len(steps.scene.mesh.nodes))
    return max(1, int(min(cores(), _MEMORY_SHARE * memory() / bytes_per_solve)))


def many_solves[T, R](
    simulator: EquilibriumSolver, solve: Callable[[T], R], tasks: Iterator[T], *, alone: int = 1
) -> Iterator[R]:
    """Yield ``solve`` of every task, in their order: by the simulator's engine, or by threads.

    solve : the function of a task; what it holds of the simulator is sent to a worker once.
    alone : the number of tasks that come before the others, which use what they compile.
    """
    engine = getattr(simulator, "engine", None)  # a simulator of another class may have none
    return in_order(solve, tasks, at_once(simulator), alone=alone, engine=engine)


def in_order[T, R](
    function: Callable[[T], R],
    tasks: Iterator[T],
    workers: int,
    *,
    alone: int = 1,
    engine: Engine | None = None,
) -> Iterator[R]:
    """Yield ``function`` of every task, in their order, by an engine or by ``workers`` threads.

    The first ``alone`` tasks come before the threads, which use what they compile. Then a task is
    taken when all but ``workers`` of the results before it have been yielded. So what a task is
    made of, such as a start from earlier rows, does not depend on which thread was quicker. While
    the threads work, as many factors are kept as there are threads.
    """
    if engine is not None:
        yield from engine.in_order(function, tasks, alone=alone)
        return
    for task in islice(tasks, alone):
        yield function(task)
    if workers == 1:
        yield from map(function, tasks)
        return
    pending: deque[Future[R]] = deque()
    on_thread = inherited(function)
    pool = ThreadPoolExecutor(workers)
    with keeping_factors(workers):
        try:
            for task in tasks:
                pending.append(pool.submit(on_thread, task))
                if len(pending) > workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
