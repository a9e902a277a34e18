"""Solves on a Dask cluster.

The scene goes to every worker once, also to one that starts later, and each worker keeps its
compiled programs. It solves one theta at a time, whatever its number of threads. This process
keeps two tasks a worker under way and does all the writing, so that a task has the start that is
best by then, and a row whose worker was killed is solved again by another and written once.

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
from typing import Any, cast

import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.fem.campaign.engine import Solver
from emulator.fem.campaign.row import Row, Task
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
_LOOK_S = 2.0  # between two looks at whether workers are there
_UNDER_WAY = 2  # tasks a worker: one being solved, one waiting there
_ADDRESS = re.compile(r"(tcp|tls|ucx|ws|wss)://[^/\s]+:\d+")


@dataclass(frozen=True)
class Cluster:
    """An executor: solves on the workers of a connected client; :func:`connected` makes it."""

    client: Client
    address: str
    _sent: dict[Solver, str] = field(default_factory=dict)

    def __call__(self, solver: Solver, tasks: Iterator[Task]) -> Iterator[Row]:
        """Rows as they come back.

        Raises
        ------
        SolverError
            No workers for a minute, the scheduler has gone, or a theta that killed each worker it
            was given to; all other rows come first.
        """
        try:
            yield from self._rows(self._name(solver), tasks)
        except (OSError, CancelledError) as error:  # an error of the solve itself is neither
            raise self._gone(error) from error

    def _name(self, solver: Solver) -> str:
        """The name that workers know ``solver`` by; they are sent it once."""
        if solver not in self._sent:
            name = f"campaign-{uuid.uuid4().hex}"
            self.client.register_plugin(Bench(solver), name=name)
            self._sent[solver] = name
        return self._sent[solver]

    def _rows(self, name: str, tasks: Iterator[Task]) -> Iterator[Row]:
        under_way: dict[Future, int] = {}
        deadly: list[int] = []
        while True:
            for task in _some(tasks, _UNDER_WAY * self._workers() - len(under_way)):
                future = self.client.submit(_solve, name, _as_numpy(task), pure=False)
                under_way[future] = task.number
            if not under_way:
                break
            for future in self._finished(under_way):
                try:
                    row = _result(future)
                except TimeoutError:  # it went with its worker, and is solved again
                    continue
                number = under_way.pop(future)
                if row is None:
                    deadly.append(number)
                else:
                    yield row
        if deadly:
            raise SolverError(
                f"campaign: theta {', '.join(map(str, deadly))} killed every worker it was given "
                "to, perhaps for want of memory; all others are solved"
            )

    def _workers(self) -> int:
        """Number of workers; waits for the first."""
        began = time.monotonic()
        while True:
            count = self._count()
            if count:
                return count
            if time.monotonic() - began > WORKERS_S:
                raise SolverError(
                    f"campaign: the scheduler {self.address} has had no worker for {WORKERS_S:g} s"
                )
            time.sleep(0.2)

    def _finished(self, under_way: dict[Future, int]) -> list[Future]:
        """The futures that are done, at least one of them; watches over the workers meanwhile."""
        while True:
            try:
                with self.client.as_current():
                    wait(list(under_way), timeout=_LOOK_S, return_when="FIRST_COMPLETED")
            except TimeoutError:
                self._workers()
            done = [future for future in under_way if future.done()]
            if done:
                return done

    def _count(self) -> int:
        try:
            return len(self.client.nthreads())
        except (RuntimeError, ValueError) as error:  # the client has given up
            raise self._gone(error) from error

    def _gone(self, error: Exception) -> SolverError:
        said = " ".join(str(error).split())
        return SolverError(f"campaign: the scheduler {self.address} does not answer ({said})")

    def forget(self) -> None:
        """Let the workers forget the scenes, where there still are any."""
        for name in self._sent.values():
            with suppress(OSError, CancelledError, RuntimeError, ValueError, KeyError):
                self.client.unregister_worker_plugin(name)
        self._sent.clear()


@contextmanager
def connected(address: str, *, within: float | None = None) -> Iterator[Cluster]:
    """A cluster whose scheduler is at ``address``.

    Raises
    ------
    InputError
        The address is malformed, or nobody answers there in ``within`` seconds (10).
    """
    within = CONNECT_S if within is None else within
    check_address(address)
    try:
        client = Client(address, timeout=within, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"scheduler {address} does not answer within {within:g} s; is it running?"
        ) from error
    cluster = Cluster(client, address)
    try:
        yield cluster
    finally:
        cluster.forget()
        client.close()


def check_address(address: str) -> None:
    """:class:`InputError` unless ``address`` looks like a scheduler's."""
    if not _ADDRESS.fullmatch(address):
        raise InputError(f"scheduler '{address}' is no address; give e.g. tcp://127.0.0.1:8786")


class Bench(WorkerPlugin):
    """What a worker needs to solve tasks, sent to it once."""

    def __init__(self, solver: Solver) -> None:
        scene = solver.simulator.scene
        # What a scene has cached stays behind.
        self._scene = {field.name: getattr(scene, field.name) for field in fields(Scene)}
        self._fingerprint = scene.fingerprint
        self._newton = solver.simulator.options
        self._factorisation = solver.simulator.factorisation
        options = {field.name: getattr(solver, field.name) for field in fields(Solver)}
        self._options = {name: v for name, v in options.items() if name != "simulator"}

    def setup(self, worker: Any) -> None:  # noqa: ARG002 - Dask's interface
        """Called on each worker."""
        self._lock = threading.Lock()

    def solve(self, task: Task) -> Row:
        """The row of ``task``, with NumPy arrays."""
        with self._lock:
            return self._solver(task).as_numpy()

    @cached_property
    def _solver(self) -> Solver:
        scene = Scene(**self._scene)
        if scene.fingerprint != self._fingerprint:
            raise SolverError(
                f"campaign: a worker makes another scene of '{scene.name}'; give it this version"
            )
        return Solver(Simulator(scene, self._newton, self._factorisation), **self._options)


def _solve(name: str, task: Task) -> Row:
    """Run on a worker."""
    bench = cast(Bench, get_worker().plugins[name])
    return bench.solve(task)


def _result(future: Future) -> Row | None:
    """The row, or None where its theta killed workers."""
    try:
        return future.result(timeout=_LOOK_S)
    except KilledWorker:
        return None


def _as_numpy(task: Task) -> Task:
    starts = tuple(np.asarray(start) for start in task.starts)
    return Task(task.number, np.asarray(task.theta), starts)


def _some(tasks: Iterator[Task], count: int) -> Iterator[Task]:
    for _, task in zip(range(count), tasks, strict=False):
        yield task
