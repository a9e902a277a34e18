"""Timing. No theta is timed twice: direct solvers keep factors of values they have seen."""

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
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


def clocked(
    function: Callable[..., Any], *arguments: Any, clock: Clock = time.perf_counter
) -> tuple[float, Any]:
    """Seconds of one call, and what it gave."""
    begin = clock()
    result = jax.block_until_ready(function(*arguments))
    return clock() - begin, result
