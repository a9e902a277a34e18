"""How many optimiser steps fit into a time budget, aimed again while they run."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.training.checkpoint import State
from emulator.training.network import NetworkTraining
from emulator.training.plan import Plan
from emulator.training.step import WARMUP

_AIM_EVERY = 200  # steps
_CLOCKED = 8  # steps that are timed beforehand


class Aim:
    """Sets the number of steps so that training ends at a deadline; a hook of the loop.

    A machine becomes busier or less so, and steps become cheaper once the modes are frozen. With a
    discrepancy model to follow, which soon outdoes the network, the plan's steps are the most.
    """

    def __init__(self, deadline: float, plan: Plan) -> None:
        self._deadline = deadline
        self._most = plan.steps if plan.discrepancy else np.iinfo(np.int64).max
        # The first step after freezing compiles; the clock starts after it.
        self._restart = plan.freeze + 1 if plan.decoder == "separable" else -1
        self._began, self._first = time.perf_counter(), 0

    def first_total(self, training: NetworkTraining) -> int:
        """The number of steps to begin with, from a few that are timed and thrown away."""
        fitting = steps_within(self._deadline - time.perf_counter(), training)
        self._began = time.perf_counter()
        return min(fitting, self._most)

    def __call__(self, state: State, total: int) -> int:
        """The number of steps from what the last ones took."""
        if state.done == self._restart:
            self._began, self._first = time.perf_counter(), state.done
        elif state.done % _AIM_EVERY == 0:
            jax.block_until_ready(state.loss)
            now = time.perf_counter()
            one = (now - self._began) / (state.done - self._first)
            return min(state.done + max(int((self._deadline - now) / one), 0), self._most)
        return total


def steps_within(seconds: float, training: NetworkTraining) -> int:
    """How many steps fit into ``seconds``.

    Raises
    ------
    InputError
        Fewer than a warm-up.
    """
    plan = training.plan
    started = time.perf_counter()
    one = late = _seconds_a_step(training)
    if plan.decoder == "separable":
        late = _seconds_a_step(training, *training.keep(training.initial()[0]))
    left = 0.98 * seconds - (time.perf_counter() - started)
    early = min(left / one, plan.freeze) if late < one else left / one
    steps = int(early + max(left - early * one, 0.0) / late)
    if steps < WARMUP:
        raise InputError(
            f"the budget leaves {max(steps, 0)} training steps of {1e3 * one:.0f} ms after FEM "
            f"runs and compilation; give at least {WARMUP * one - left:.0f} s more"
        )
    return steps


def _seconds_a_step(training: NetworkTraining, *kept: jax.Array) -> float:
    """Median seconds of a step, compilation excluded."""
    weights, optimiser = training.initial()
    total = jnp.asarray(training.plan.steps)
    durations = []
    for number in range(_CLOCKED):
        begin = time.perf_counter()
        weights, optimiser, value = training.step(
            weights, optimiser, jnp.asarray(number), total, *kept
        )
        value.block_until_ready()
        durations.append(time.perf_counter() - begin)
    return float(np.median(durations[1:]))
