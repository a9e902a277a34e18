"""Several solves at once in one process.

A solve is one compiled program, which holds no lock of Python's, and CHOLMOD's factorisation uses
one core. Two solves on two cores take 0.56 of the time of one after the other on a ventricle of
4627 nodes, 0.61 at 33 605 (docs/experiments.md, "Two solves at once").
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from emulator.core.machine import cores, inherited, memory
from emulator.fem.linear.suitesparse import FACTORS
from emulator.fem.simulator import Simulator

_BYTES_A_NODE = 100_000  # of one more solve beside others; 54 000 measured at 33 605 nodes
_SHARE = 0.5  # of the machine's memory


def at_once(simulator: Simulator, nodes: int | None = None) -> int:
    """Solves that this machine does at once: one a core that this process may use, fewer where
    memory would not hold them.

    One where a factor is kept between solves, or the solver is called from Python: large meshes.
    And one of a simulator that is not FEM's own: nobody said that threads may share it.

    nodes : of the mesh that is solved on; the simulator's by default.
    """  # noqa: D205
    if not isinstance(simulator, Simulator) or simulator.stepwise:
        return 1
    each = _BYTES_A_NODE * (nodes or len(simulator.scene.mesh.nodes))
    return max(1, int(min(cores(), _SHARE * memory() / each)))


def in_order[T, R](function: Callable[[T], R], tasks: Iterator[T], workers: int) -> Iterator[R]:
    """``function`` of every task, in their order, on ``workers`` threads.

    The first task is done alone: what it compiles, the others use. After it a task is taken when
    all but ``workers`` of those before it have been given back, so that what a task is made of,
    such as a start from rows so far, does not depend on which thread was quicker. Each thread has
    room for a factor of its own while they work.
    """
    for task in tasks:
        yield function(task)
        break
    if workers == 1:
        yield from map(function, tasks)
        return
    under_way: deque[Future[R]] = deque()
    there = inherited(function)
    pool = ThreadPoolExecutor(workers)
    with FACTORS.keep(workers):
        try:
            for task in tasks:
                under_way.append(pool.submit(there, task))
                if len(under_way) > workers:
                    yield under_way.popleft().result()
            while under_way:
                yield under_way.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
