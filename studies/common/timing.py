"""Timing. No theta is timed twice: direct solvers keep factors of values they have seen."""

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import emulator as em

Function = Callable[[jax.Array], Any]
Clock = Callable[[], float]


def unseen(scene: em.Scene, count: int, *, keys: Iterator[int] = itertools.count()) -> jax.Array:
    """Theta (count, p) that no call has had before."""
    return em.fem.uniform(scene, count, jax.random.key(2000 + next(keys)))


def per_call(function: Function, arguments: jax.Array, clock: Clock = time.perf_counter) -> float:
    """Median seconds of one call from Python, dispatch included.

    clock : ``time.process_time`` for processor seconds, where other work shares the core.
    """
    each = [jax.block_until_ready(row) for row in arguments]
    jax.block_until_ready(function(each[0]))
    durations = []
    for argument in each[1:]:
        begin = clock()
        jax.block_until_ready(function(argument))
        durations.append(clock() - begin)
    return float(np.median(durations))


def loop(function: Function) -> Function:
    """One program that sums ``function`` over many theta, so that nothing can be left out."""

    def step(total: jax.Array, theta: jax.Array) -> tuple[jax.Array, None]:
        leaves = jax.tree.leaves(function(theta))
        return total + sum(jnp.sum(leaf) for leaf in leaves), None

    return jax.jit(lambda thetas: jax.lax.scan(step, jnp.zeros(()), thetas)[0])


def in_loop(function: Function, scene: em.Scene, count: int, repeats: int = 5) -> float:
    """Median over ``repeats`` of the seconds per theta in a compiled loop over ``count`` theta."""
    batches = unseen(scene, count * (repeats + 1)).reshape(repeats + 1, count, -1)
    return per_call(loop(function), batches) / count


def batched(function: Function, scene: em.Scene, size: int, repeats: int = 5) -> float:
    """Median over ``repeats`` of the seconds per theta in one call of ``size`` under ``vmap``."""
    batches = unseen(scene, size * (repeats + 1)).reshape(repeats + 1, size, -1)
    return per_call(jax.jit(jax.vmap(function)), batches) / size


def clocked(
    function: Callable[..., Any], *arguments: Any, clock: Clock = time.perf_counter
) -> tuple[float, Any]:
    """Seconds of one call, and what it gave."""
    begin = clock()
    result = jax.block_until_ready(function(*arguments))
    return clock() - begin, result


def milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1e3 * seconds:.4f} ms"
