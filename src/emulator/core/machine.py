"""The cores and memory that this process may use, and the one global switch: JAX in float64.

Sparse factorisation, Newton's method and likelihoods need float64, and the sparse solvers accept
nothing else. Importing :mod:`emulator` turns it on, once, here. Networks ask for float32
explicitly, so their speed is not affected.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import jax
import jax.numpy as jnp
from threadpoolctl import threadpool_limits

from emulator.core.errors import InputError

jax.config.update("jax_enable_x64", True)

PROCESS_GROUPS = Path("/proc/self/cgroup")
GROUPS = Path("/sys/fs/cgroup")


def require_float64(what: str) -> None:
    """Raise :class:`InputError` where float64 is switched off; costs nothing inside ``jit``."""
    if jnp.result_type(float) != jnp.float64:
        raise InputError(
            f"{what} needs float64: leave jax_enable_x64 on, as importing emulator did"
        )


def cores() -> int:
    """Return the number of cores that this process may use, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    return max(1, min([count, *(int(limit) for limit in _core_limits())]))


def memory() -> float:
    """Return the bytes of memory of the machine or, if less, of the container of this process.

    It is infinite where the machine does not say.
    """
    try:
        total = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        total = float("inf")
    limits = (text[0] for _, text in _limits("memory.max", "memory.limit_in_bytes"))
    return min([total, *(float(limit) for limit in limits if limit.isdecimal())])


def _core_limits() -> Iterator[float]:
    """Yield the limits that control groups of versions 2 and 1 set to the number of cores."""
    for folder, (quota, *period) in _limits("cpu.max", "cpu.cfs_quota_us"):
        if quota.isdecimal():  # neither "max" nor -1
            microseconds = period or (folder / "cpu.cfs_period_us").read_text().split()
            yield float(quota) / float(microseconds[0])


def _limits(two: str, one: str) -> Iterator[tuple[Path, list[str]]]:
    """Yield each folder that holds a limit of this process, and the limit's words.

    two, one : the names of the limit's file in control groups of version 2 and of version 1.

    A group is bound by those around it, too. In a container the group's own name may be that of
    the host, whose folder is not there, and the limit is at the root.
    """
    controller = one.split(".")[0]
    try:
        rows = PROCESS_GROUPS.read_text().splitlines()
    except OSError:  # no Linux
        return
    for row in rows:
        _, controllers, name = row.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        root, file = (GROUPS / controllers, one) if controllers else (GROUPS, two)
        group = Path(name.lstrip("/"))
        for folder in dict.fromkeys(root / path for path in (group, *group.parents)):
            with suppress(OSError):
                if words := (folder / file).read_text().split():
                    yield folder, words


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS to one thread, as a context or as a decorator of a function.

    For many small matrices, or several threads that call BLAS. With a thread a core in each call,
    these wait for each other, in L-BFGS-B fifty times as long as they compute.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


def require_cpu(what: str) -> None:
    """Raise :class:`InputError` where JAX computes on an accelerator by default."""
    platform = _platform()
    if platform != "cpu":
        raise InputError(
            f"{what} runs on the CPU, and JAX's default device is '{platform}'; set "
            "JAX_PLATFORMS=cpu, or make what needs it under "
            "jax.default_device(jax.devices('cpu')[0])"
        )


def _platform() -> str:
    """Return the platform of the default JAX device of the calling thread."""
    device = jax.config.jax_default_device
    return jax.default_backend() if device is None else getattr(device, "platform", device)


def inherited[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Return ``function`` for other threads, run on the calling thread's default device."""
    device = jax.config.jax_default_device

    def on_device(*arguments: P.args, **named: P.kwargs) -> R:
        with jax.default_device(device):
            return function(*arguments, **named)

    return on_device
