"""Where solves are done: in this process, or on a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from emulator.fem.campaign.engine import Executor, in_process


@contextmanager
def executor(scheduler: str | None) -> Iterator[Executor]:
    """Where to solve: in this process, or on the workers of the Dask scheduler at that address.

    Raises
    ------
    InputError
        The address is malformed, or nobody answers there.
    """
    if scheduler is None:
        yield in_process
        return
    from emulator.fem.campaign.cluster import connected

    with connected(scheduler) as cluster:
        yield cluster
