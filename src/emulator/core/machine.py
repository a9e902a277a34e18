"""The cores and memory that this process may use, and the one global switch: JAX in float64.

Sparse factorisation, Newton's method and likelihoods need float64, and the sparse solvers accept
nothing else. Importing :mod:`emulator` turns it on, once, here. Networks ask for float32
explicitly, so their speed is not affected.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
from threadpoolctl import threadpool_limits

from emulator.core.errors import InputError

jax.config.update("jax_enable_x64", True)


def require_float64(what: str) -> None:
    """Raise :class:`InputError` where float64 is switched off; costs nothing inside ``jit``."""
    if jnp.result_type(float) != jnp.float64:
        raise InputError(
            f"{what} needs float64: leave jax_enable_x64 on, as importing emulator did"
        )


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory() -> float:
    """Return the memory of the machine in bytes; infinity where the machine does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


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
