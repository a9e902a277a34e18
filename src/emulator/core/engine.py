"""Engines: where many solves are done, in threads of this process or by any executor.

An executor is anything with ``submit`` of :mod:`concurrent.futures`, whose futures have ``result``:
a pool of processes, ``dask.distributed``'s ``Client.get_executor()``, ``mpi4py.futures``,
``executorlib``. It belongs to the solver, which every place that does many solves has. What goes to
a worker is a function, small arguments, and the digests of what they hold that is large: objects
whose class says ``sent_once``, such as the simulator of a scene. Their bytes go with the tasks
until all workers have answered, or many times as many tasks are done as there are workers; a worker
that still lacks one says so. It keeps what it builds and compiles of them.

Bytes are pickled by this process for its own workers, and are never read from a file.
"""

from __future__ import annotations

import hashlib
import io
import multiprocessing
import os
import pickle
import platform
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, lru_cache, partial
from multiprocessing import connection
from types import MappingProxyType
from typing import Any, NamedTuple

import cloudpickle
import jax
from tqdm import tqdm

from emulator.core.errors import InputError, SolverError
from emulator.core.machine import cores, one_blas_thread

THREADS = "threads"
"""The word of the threads of this process."""
USAGE = "threads, processes:N or dask:ADDRESS"
"""The words of an engine."""
SENT_ONCE = "sent_once"
"""Attribute of a class whose objects workers get once, and keep."""
STAYS = "stays"
"""Metadata of a dataclass's field that no worker gets."""
_DEATHS = 3  # of workers, with one task, after which it is named as their cause
_ANSWERS = 8  # a worker, after which an object goes only to whom it lacks
_KEPT = 8  # objects that a worker keeps, the last used


class Engine:
    """Does tasks by an executor, in their order.

    executor : the executor. workers : the number of its workers.
    renewed : the function that returns another executor where a worker's death ends the first;
        None where the executor replaces its workers itself, or cannot be replaced.
    """

    def __init__(
        self, executor: Executor, workers: int, renewed: Callable[[], Executor] | None = None
    ) -> None:
        self.workers = workers
        self._executor, self._renewed = executor, renewed
        self._keepers = dict[str, list[str]]()  # the worker of each first answer, by object

    def in_order[T, R](
        self,
        function: Callable[[T], R],
        tasks: Iterator[T],
        *,
        alone: int = 1,
        ahead: int | None = None,
    ) -> Iterator[R]:
        """Yield ``function`` of every task, in the order of the tasks.

        The first ``alone`` tasks come one after the other. Then a task is taken when all but
        ``ahead`` of the results before it have been yielded, by default as many as workers.

        :class:`SolverError` where workers die of one task, or one dies whom nothing replaces.
        """
        sender, pending = _Sender(function), deque[_Sent]()
        try:
            for number, task in enumerate(tasks):
                packed = sender.packed(task)  # which adds digests
                with_objects = any(map(self._is_new, sender.digests))
                pending.append(_Sent(number, packed, with_objects=with_objects))
                self._submit(pending, sender)
                while len(pending) > ((ahead or self.workers) if number >= alone else 0):
                    yield self._first(pending, sender)
            while pending:
                yield self._first(pending, sender)
        finally:
            for sent in pending:
                getattr(sent.future, "cancel", bool)()  # which a future need not have

    def _first(self, pending: deque[_Sent], sender: _Sender) -> Any:
        """Return the result of the first task, which is sent again until it has one."""
        while True:
            self._submit(pending, sender)
            sent = pending[0]
            assert sent.future is not None
            try:
                answer = sent.future.result()
            except BrokenExecutor as error:
                self._renew(pending, error)
                continue
            if isinstance(answer, _Answer):
                for digest in filter(self._is_new, sender.digests):
                    self._keepers.setdefault(digest, []).append(answer.worker)
                pending.popleft()
                return answer.result
            sent.future, sent.with_objects = None, True  # the answer is what it lacks

    def _is_new(self, digest: str) -> bool:
        """Say whether a worker may lack an object: not all have answered since it was sent.

        An executor may have fewer workers than it seems, or threads, which are one worker.
        """
        workers = self._keepers.get(digest, [])
        return len(set(workers)) < self.workers and len(workers) < _ANSWERS * self.workers

    def _submit(self, pending: deque[_Sent], sender: _Sender) -> None:
        """Submit the tasks that are not with the executor."""
        for sent in pending:
            while sent.future is None:
                try:
                    sent.future = sender.submitted(self._executor, sent)
                except BrokenExecutor as error:  # a worker died since the last result
                    self._renew(pending, error)

    def _renew(self, pending: deque[_Sent], error: BrokenExecutor) -> None:
        """Replace the executor; tasks that went with it are to be submitted again."""
        first = pending[0]
        first.deaths += 1
        if self._renewed is None:
            raise SolverError(
                f"a worker died with run {first.number + 1}, and its executor cannot be replaced: "
                f"name an engine in words ({USAGE})"
            ) from error
        if first.deaths >= _DEATHS:
            raise SolverError(
                f"{_DEATHS} workers died with run {first.number + 1}: out of memory? Take fewer"
            ) from error
        lost = [sent for sent in pending if sent.is_lost]
        numbers = ", ".join(str(sent.number + 1) for sent in lost)
        tqdm.write(f"a worker died; done again: run {numbers or first.number + 1}", file=sys.stderr)
        self._executor = self._renewed()
        self._keepers.clear()
        for sent in lost:
            sent.future = None


@dataclass
class _Sent:
    """A task: its number, its bytes, and the future of its result, once it is submitted.

    with_objects : whether what it holds that is large goes with it.
    deaths : the number of workers that died while it was the first of all tasks.
    """

    number: int
    task: bytes
    future: Future[Any] | None = None
    with_objects: bool = False
    deaths: int = 0

    @property
    def is_lost(self) -> bool:
        """Say whether it was submitted and has no result, or ended with its executor."""
        future = self.future
        return future is not None and (not future.done() or future.exception() is not None)


class _Answer(NamedTuple):
    """The result of a task, and the name of the worker that did it."""

    result: Any
    worker: str


class _Lacking(NamedTuple):
    """The answer of a worker that lacks an object, by its digest."""

    digest: str


class _AbsentError(Exception):
    """A worker was not sent an object."""


class _Sender:
    """Packs a function and its tasks, and the objects that both hold, each once."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._objects = dict[str, bytes]()
        self._digests = dict[int, tuple[Any, str]]()  # the object is kept, so its id is not reused
        self._function = self._kept_by_workers(function)
        self._cache = jax.config.jax_compilation_cache_dir

    @property
    def digests(self) -> list[str]:
        """The digests of the function and of what it and the tasks so far hold that is large."""
        return [*self._objects]

    def packed(self, thing: Any) -> bytes:
        """Return ``thing`` as bytes, with digests for the objects that are sent once."""
        return _packed(thing, self._digest)

    def _digest(self, thing: Any) -> str | None:
        return self._kept_by_workers(thing) if getattr(type(thing), SENT_ONCE, False) else None

    def _kept_by_workers(self, thing: Any) -> str:
        """Return the digest of what workers keep."""
        if id(thing) not in self._digests:
            content = _packed(thing, lambda inner: None if inner is thing else self._digest(inner))
            digest = hashlib.sha256(content).hexdigest()
            self._objects[digest] = content
            self._digests[id(thing)] = thing, digest
        return self._digests[id(thing)][1]

    def submitted(self, executor: Executor, sent: _Sent) -> Future[Any]:
        """Return the future of one task."""
        objects = self._objects if sent.with_objects else {}
        return executor.submit(_work, self._function, sent.task, objects, self._cache, os.getpid())


class _Pickler(cloudpickle.Pickler):  # which packs functions inside functions, and a notebook's
    def __init__(self, file: io.BytesIO, digest: Callable[[Any], str | None]) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.persistent_id = digest

    def reducer_override(self, thing: Any) -> Any:
        """Make dataclasses of these packages from their fields: not from what they compiled."""
        if isinstance(thing, MappingProxyType):
            return _frozen, (dict(thing),)
        of_ours = type(thing).__module__.startswith(("emulator.", "calibrate."))
        if of_ours and is_dataclass(thing) and not isinstance(thing, type):
            sent = (f.name for f in fields(thing) if f.init and not f.metadata.get(STAYS))
            values = {name: getattr(thing, name) for name in sent}
            return _made, (type(thing), values)
        return super().reducer_override(thing)


def _made(kind: Callable[..., Any], values: Mapping[str, Any]) -> Any:
    return kind(**values)


def _frozen(entries: dict[Any, Any]) -> Mapping[Any, Any]:
    return MappingProxyType(entries)  # whose class pickle does not find by its name


def _packed(thing: Any, digest: Callable[[Any], str | None]) -> bytes:
    file = io.BytesIO()
    _Pickler(file, digest).dump(thing)
    return file.getvalue()


# ---- in a worker ---------------------------------------------------------------------------------
@lru_cache(_KEPT)
def _slot(digest: str) -> list[Any]:  # noqa: ARG001 - its name
    """Return where this worker keeps what it was sent once, empty before."""
    return []


class _Unpickler(pickle.Unpickler):
    def __init__(self, content: bytes, objects: Mapping[str, bytes]) -> None:
        super().__init__(io.BytesIO(content))
        self._sent = objects

    def persistent_load(self, digest: str) -> Any:
        """Return the object of ``digest``, which this worker was sent, now or before."""
        slot = _slot(digest)
        if not slot:
            if digest not in self._sent:
                raise _AbsentError(digest)
            slot.append(_Unpickler(self._sent[digest], self._sent).load())
        return slot[0]


def _work(
    function: str, task: bytes, objects: Mapping[str, bytes], folder: str | None, asker: int
) -> _Answer | _Lacking:
    """Return the function's result for one task, or which object this worker lacks.

    function : its digest.
    folder : the folder of compiled programs, shared with the process that asks.
    asker : the number of that process, whose threads do not set the threads of its BLAS.
    """
    if folder is not None and jax.config.jax_compilation_cache_dir != folder:
        jax.config.update("jax_compilation_cache_dir", folder)
    try:
        unpickler = _Unpickler(task, objects)
        call, argument = unpickler.persistent_load(function), unpickler.load()
    except _AbsentError as digest:
        return _Lacking(str(digest))
    with nullcontext() if os.getpid() == asker else one_blas_thread():
        result = jax.block_until_ready(call(argument))
    return _Answer(result, f"{platform.node()} {os.getpid()}")


# ---- by words ------------------------------------------------------------------------------------
def check_engine(words: str) -> tuple[str, str]:
    """Return the kind of an engine and what it is of; :class:`InputError` for other words."""
    kind, _, rest = words.partition(":")
    counted = kind == "processes" and rest.isascii() and rest.isdigit() and int(rest) > 0
    if words != THREADS and not counted and not (kind == "dask" and rest):
        raise InputError(f"engine '{words}': give {USAGE}")
    return kind, rest


def engine_of(executor: Executor | str | None) -> Engine | None:
    """Return the engine of an executor or of words; None for threads of this process.

    :class:`InputError` for other words, or where what they name is not installed or not there.
    """
    if executor is None or executor == THREADS:
        return None
    if not isinstance(executor, str):
        if not callable(getattr(executor, "submit", None)):
            raise InputError(f"executor is a {type(executor).__name__}; it has no submit")
        return Engine(executor, getattr(executor, "_max_workers", None) or cores())
    return _named(executor)


def end_with_parent() -> None:
    """End this worker when the process that began it has died.

    A killed process closes nothing, and its workers hold each other's pipes open: they would wait
    for tasks, with all that they have compiled, until the machine stops.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:

        def wait() -> None:
            connection.wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=wait, daemon=True).start()


@cache
def _named(words: str) -> Engine:
    """Return the engine of ``words``, of which this process has one: its workers compiled much."""
    kind, rest = check_engine(words)
    if kind == "processes":
        # Not by fork: JAX has threads.
        context = multiprocessing.get_context("spawn")
        renewed = partial(ProcessPoolExecutor, int(rest), context, end_with_parent)
        return Engine(renewed(), int(rest), renewed)
    try:
        from distributed import Client

        client = Client(rest, timeout=10)
    except ModuleNotFoundError:
        raise InputError(f"engine '{words}': install dask and distributed") from None
    except (OSError, ValueError) as error:
        raise InputError(f"engine '{words}': {error}") from None
    workers = sum(client.ncores().values())
    if not workers:
        raise InputError(f"engine '{words}': the cluster has no worker")
    # A solve uses one core, and what it compiles is of its process: one at a time in each.
    return Engine(client.get_executor(), workers)
