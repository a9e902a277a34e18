"""Solves on a Dask cluster.

The scene goes to every worker once, also to one that starts later, and each worker keeps its
compiled programs. It solves one theta at a time, whatever its number of threads. This process
keeps two tasks a worker pending and does all the writing, so that a task has the best start known
when it is taken, and a row whose worker was killed is solved again by another and written once.

Dask sends Python objects between its processes as pickles: client, scheduler and workers must
trust each other. Nothing is read from files that way.
"""

from __future__ import annotations

import re
import threading
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import islice
from typing import Any, cast

import jax
import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.fem.campaign.workers import Row, Solver, Task
from emulator.fem.simulator import Simulator
from emulator.scenes.scene import Scene

try:
    from distributed import Client, Future, KilledWorker, get_worker, wait
    from distributed.diagnostics.plugin import WorkerPlugin
except ImportError as error:
    raise InputError(
        "a campaign on a cluster needs Dask: pip install 'soft-tissue-calibrate[cluster]'"
    ) from error

CONNECT_S = 10.0
"""Seconds in which the scheduler must answer."""
WORKERS_S = 60.0
"""Seconds after which a campaign without any worker ends."""
_POLL_S = 2.0  # between two checks that there are workers
_TASKS_A_WORKER = 2  # one is solved while the next waits on the worker
_ADDRESS = re.compile(r"(tcp|tls|ucx|ws|wss)://[^/\s]+:\d+")


@dataclass(frozen=True)
class Cluster:
    """An executor that solves on the workers of a connected client; see :func:`connected`."""

    client: Client
    address: str
    names: dict[Solver, str] = field(default_factory=dict)  # of the solvers that workers know

    def __call__(self, solver: Solver, tasks: Iterator[Task]) -> Iterator[Row]:
        """Yield rows in the order in which they come back.

        Raises :class:`SolverError`: no workers for a minute, the scheduler has gone, or a theta
        that killed each worker it was given to; all other rows come first.
        """
        try:
            yield from self._rows(self._name(solver), tasks)
        except (OSError, CancelledError) as error:  # errors of the solve itself have other types
            raise self._connection_error(error) from error

    def _name(self, solver: Solver) -> str:
        """Return the name by which workers know ``solver``; send it to them once."""
        if solver not in self.names:
            name = f"campaign-{uuid.uuid4().hex}"
            self.client.register_plugin(SolverPlugin(solver), name=name)
            self.names[solver] = name
        return self.names[solver]

    def _rows(self, name: str, tasks: Iterator[Task]) -> Iterator[Row]:
        pending: dict[Future, int] = {}
        deadly: list[int] = []
        while True:
            room = max(0, _TASKS_A_WORKER * self._workers() - len(pending))
            for task in islice(tasks, room):
                arrays = jax.tree.map(np.asarray, task)._replace(number=task.number)
                pending[self.client.submit(_solve, name, arrays, pure=False)] = task.number
            if not pending:
                break
            with suppress(TimeoutError), self.client.as_current():
                wait(list(pending), timeout=_POLL_S, return_when="FIRST_COMPLETED")
            for future in [each for each in pending if each.done()]:
                try:
                    row = future.result(timeout=_POLL_S)
                except TimeoutError:  # the worker was lost; Dask solves the task again
                    continue
                except KilledWorker:
                    deadly.append(pending.pop(future))
                    continue
                del pending[future]
                yield row
        if deadly:
            raise SolverError(
                f"campaign: theta {', '.join(map(str, deadly))} killed every worker it was given "
                "to, perhaps for want of memory; all others are solved"
            )

    def _workers(self) -> int:
        """Return the number of workers; wait for the first."""
        began = time.monotonic()
        while time.monotonic() - began <= WORKERS_S:
            try:
                count = len(self.client.nthreads())
            except (RuntimeError, ValueError) as error:  # the client has given up
                raise self._connection_error(error) from error
            if count:
                return count
            time.sleep(0.2)
        raise SolverError(
            f"campaign: the scheduler {self.address} has had no worker for {WORKERS_S:g} s"
        )

    def _connection_error(self, error: Exception) -> SolverError:
        message = " ".join(str(error).split())
        return SolverError(f"campaign: the scheduler {self.address} does not answer ({message})")


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """Yield a cluster whose scheduler is at ``address``.

    Raises :class:`InputError`: the address is malformed, or nobody answers there in 10 seconds.
    """
    check_address(address)
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"scheduler {address} does not answer within {CONNECT_S:g} s; is it running?"
        ) from error
    cluster = Cluster(client, address)
    try:
        yield cluster
    finally:
        for name in cluster.names.values():  # workers that are still there forget the solvers
            with suppress(OSError, CancelledError, RuntimeError, ValueError, KeyError):
                client.unregister_worker_plugin(name)
        client.close()


def check_address(address: str) -> None:
    """Raise :class:`InputError` unless ``address`` looks like the address of a scheduler."""
    if not _ADDRESS.fullmatch(address):
        raise InputError(f"scheduler '{address}' is no address; give e.g. tcp://127.0.0.1:8786")


class SolverPlugin(WorkerPlugin):
    """A solver as it is sent to a worker, once: its scene and options, without cached arrays."""

    def __init__(self, solver: Solver) -> None:
        simulator, scene = solver.simulator, solver.simulator.scene
        self._scene = {each.name: getattr(scene, each.name) for each in fields(Scene)}
        self._fingerprint = scene.fingerprint
        self._newton = simulator.options
        self._options = solver.sensitivities, solver.energy, solver.from_rest_again

    def setup(self, worker: Any) -> None:  # noqa: ARG002 - Dask's interface
        """Prepare each worker; Dask calls this."""
        self._lock = threading.Lock()

    def solve(self, task: Task) -> Row:
        """Return the row of ``task``, with NumPy arrays."""
        with self._lock:
            return self._solver(task).as_numpy()

    @cached_property
    def _solver(self) -> Solver:
        scene = Scene(**self._scene)
        if scene.fingerprint != self._fingerprint:
            raise SolverError(
                f"campaign: a worker makes another scene of '{scene.name}'; give it this version"
            )
        return Solver(Simulator(scene, self._newton), *self._options)


def _solve(name: str, task: Task) -> Row:
    """Solve a task; a worker runs this."""
    return cast(SolverPlugin, get_worker().plugins[name]).solve(task)
