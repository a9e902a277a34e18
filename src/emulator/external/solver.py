"""An external solver as what solves an external problem: the counterpart of FEM's simulator."""

from __future__ import annotations

import sys
import threading
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from emulator.core.engine import STAYS, Engine, engine_of
from emulator.core.errors import SolverError
from emulator.core.machine import cores
from emulator.external.problem import ExternalProblem, RunAnswer
from emulator.fem.solution import Solution, Status


@dataclass(frozen=True, eq=False)
class ExternalSimulator:
    """Solves an external problem; a run that fails is a solution with that status.

    scene : the problem.
    executor : the executor or the words of an engine that does many runs, as a simulator's.
    """

    scene: ExternalProblem
    executor: Executor | str | None = field(default=None, metadata={STAYS: True})

    sent_once = True

    @cached_property
    def engine(self) -> Engine | None:
        """The engine that does many runs: the executor, or threads that wait for processes."""
        workers = self.scene.solver.at_once or cores()
        engine = engine_of(self.executor)
        if engine is None and workers > 1:
            return Engine(ThreadPoolExecutor(workers), workers)
        return engine

    @cached_property
    def _last(self) -> threading.local:
        return threading.local()

    def _answer(self, theta: np.ndarray) -> RunAnswer:
        """Return the answer at ``theta`` (p,); a thread keeps its last one, for its derivatives."""
        key, answer = getattr(self._last, "answer", (b"", None))
        if answer is None or key != theta.tobytes():
            answer = self.scene.solver.run(self.scene, theta)
            self._last.answer = theta.tobytes(), answer
        return answer

    def solve(self, theta: jax.Array, start: jax.Array | None = None) -> Solution:  # noqa: ARG002
        """Return the outputs at ``theta`` (p,), (n, 3) in the first column; there is no start."""
        point, outputs = np.asarray(theta, dtype=float), np.full(self.scene.node_count, np.nan)
        status = Status.CONVERGED
        try:
            outputs = self._answer(point).outputs
        except SolverError as error:
            values = ", ".join(f"{n} = {v:.6g}" for n, v in self.scene.values(point).items())
            tqdm.write(f"a run failed at {values}: {error}", file=sys.stderr)
            status = Status.FAILED
        numbers = jnp.zeros((len(outputs), 3)).at[:, 0].set(outputs)
        reached = jnp.asarray(float(status == Status.CONVERGED))
        zero = jnp.asarray(0)
        return Solution(numbers, jnp.asarray(int(status)), zero, zero, jnp.asarray(0.0), reached)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the outputs (n, 3); :class:`SolverError` where the run fails."""
        numbers = self._answer(np.asarray(theta, dtype=float)).outputs
        return jnp.zeros((len(numbers), 3)).at[:, 0].set(numbers)

    def sensitivities(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the derivatives (p, n, 3) of the outputs; NaN where the solver gives none."""
        slopes = self._answer(np.asarray(theta, dtype=float)).gradients
        shape = (len(self.scene.parameters), *u.shape)
        if slopes is None:
            return jnp.full(shape, jnp.nan)
        return jnp.zeros(shape).at[..., 0].set(slopes.T)

    def is_stable(self, u: jax.Array, theta: jax.Array) -> bool | None:  # noqa: ARG002
        """Return None: whether an equilibrium is a minimum is not known of another program."""
        return None
