"""Cases in processes that may hang or crash without losing the others."""

import multiprocessing
import queue
import threading
import time
from collections.abc import Callable, Iterable
from multiprocessing.connection import Connection
from typing import Any

from studies.stability.cases import CASES, outcome

# Compiled programs stay mapped, and a process may have 65 530 maps: after some 200 cases LLVM can
# allocate no more.
MOST_CASES = 60


def work(pipe: Connection) -> None:
    """Receive names of cases and send their outcomes, until ``None`` is received."""
    while (name := pipe.recv()) is not None:
        pipe.send(outcome(name))


class Worker:
    """A process, killed when a case hangs or it has had many; the next case gets a new one."""

    def __init__(self) -> None:
        self.process: Any = None
        self.had = 0

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=work, args=(other,), daemon=True)
        self.process.start()
        self.had = 0
        other.close()

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None

    def run(self, name: str, limit: float) -> dict[str, Any]:
        """The outcome of ``name``; its status is ``hang`` or ``crash`` where there is none."""
        if self.had >= MOST_CASES:
            self.stop()
        if self.process is None:
            self.start()
        self.had += 1
        begin = time.perf_counter()
        self.pipe.send(name)
        try:
            if self.pipe.poll(limit):
                return self.pipe.recv()
            status = "hang"
        except EOFError:
            status = "crash"
        self.stop()
        lost = dict.fromkeys(("residual", "iterations", "load_reached", "stable"))
        return lost | {
            "name": name,
            "family": CASES[name][0],
            "status": status,
            "silent_wrong": False,
            "time_s": time.perf_counter() - begin,
            "note": "",
        }


def study(
    names: Iterable[str],
    workers: int,
    limit: float,
    known: Iterable[dict[str, Any]] = (),
    keep: Callable[[list[dict[str, Any]]], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Every case, in the order of ``names``; those in ``known`` are taken as they are.

    keep : is given all rows so far after each case.
    """
    names = list(names)
    rows = {row["name"]: row for row in known if row["name"] in set(names)}
    waiting: queue.SimpleQueue[str] = queue.SimpleQueue()
    for name in names:
        if name not in rows:
            waiting.put(name)

    def so_far() -> list[dict[str, Any]]:
        return [rows[name] for name in names if name in rows]

    writing = threading.Lock()

    def drain() -> None:
        worker = Worker()
        while True:
            try:
                name = waiting.get_nowait()
            except queue.Empty:
                return worker.stop()
            row = rows[name] = worker.run(name, limit)
            print(
                f"{len(rows):3d}/{len(names)} {name:44s} {row['status']:18s} "
                f"{row['time_s']:6.1f} s  {row['iterations'] or '':>4} {row['note'][:70]}",
                flush=True,
            )
            with writing:
                keep(so_far())

    threads = [threading.Thread(target=drain) for _ in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return so_far()
