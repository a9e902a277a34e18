"""The loop of optimiser steps of one network, or of several with common weights.

Everything besides the steps is a hook: progress, checkpoints, and the number of steps that fit into
a time budget.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import optax

from emulator.core.errors import InputError, SolverError
from emulator.core.progress import counting
from emulator.surrogates.network.part import Network
from emulator.training.checkpoint import Session, State
from emulator.training.step import WARMUP, Step, Weights

Advance = Callable[[State, int], State]
"""One step: from the state and the total number of steps to the next state."""
Hook = Callable[[State, int], int]
"""Called after each step with the state and the total; returns the total from there on."""

_SHOW_EVERY = 50  # steps; reading the loss waits for the step to end
_AIM_EVERY = 200  # steps between two estimates of the remaining time
_TIMED = 8  # steps that are timed before a training


def _identity(weights: Weights, _: bool) -> Weights:
    return weights


@dataclass(frozen=True, eq=False)
class NetworkTraining:
    """How a network is trained.

    network : the untrained network.
    optimiser, step : the optimiser and its step (:func:`~emulator.training.step.make_step`).
    freeze : the step at which the modes of a separable decoder are frozen, so that only its branch
        is trained from there on; ``None`` for never.
    frozen : the function from weights to the arrays that later steps take, the modes first.
    finish : from the weights after the last step, and whether to show progress, to the trained
        weights.
    """

    network: Network
    optimiser: optax.GradientTransformation
    step: Step
    freeze: int | None = None
    frozen: Callable[[Weights], tuple[jax.Array, ...]] = lambda _: ()
    finish: Callable[[Weights, bool], Weights] = _identity

    def initial(self) -> tuple[Weights, Any]:
        """Return copies of the untrained weights, and the optimiser's state."""
        weights = jax.tree.map(jnp.copy, self.network.weights)
        return weights, self.optimiser.init(weights)


def optimise(state: State, total: int, advance: Advance, hooks: Sequence[Hook]) -> State:
    """Return the state after ``total`` steps, which a hook may change."""
    while state.done < total:
        state = advance(state, total)
        for hook in hooks:
            total = hook(state, total)
    return state


def run(
    session: Session,
    state: State,
    total: int,
    advance: Advance,
    hooks: Sequence[Hook] = (),
    *,
    progress: bool,
    name: str = "train",
) -> State:
    """Return the state after all steps, from ``state`` or the checkpoint, and write checkpoints."""
    state = session.first(state, total)
    with Bar(name, state, total, shown=progress) as bar:
        return optimise(state, total, advance, [*hooks, bar, session])


def run_within(
    session: Session,
    training: NetworkTraining,
    total: int,
    deadline: float,
    most: int | None,
    *,
    progress: bool,
) -> State:
    """Return the state after ``total`` steps, or after as many as fit before a finite deadline.

    most : the largest number of steps before a deadline; ``None`` for no limit.
    """
    hooks: list[Hook] = []
    if np.isfinite(deadline):
        limit = StepLimit(deadline, most, training.freeze)
        total = limit.first_total(training, total)
        hooks.append(limit)
    state = State(*training.initial())
    return run(session, state, total, Steps([training]), hooks, progress=progress)


def require_finite(state: State) -> float:
    """Return the last loss; raise :class:`SolverError` where it is not finite."""
    loss = float(state.loss)
    if not np.isfinite(loss):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    return loss


class Steps:
    """Steps of several networks in turn, their weights in common.

    Frozen modes are computed once.
    """

    def __init__(self, trainings: Sequence[NetworkTraining]) -> None:
        self._trainings = trainings
        self._frozen: dict[int, tuple[jax.Array, ...]] = {}

    def __call__(self, state: State, total: int) -> State:
        """Return the state after the next step."""
        turn = state.done % len(self._trainings)
        training = self._trainings[turn]
        frozen: tuple[jax.Array, ...] = ()
        if training.freeze is not None and state.done >= training.freeze:
            if turn not in self._frozen:
                self._frozen[turn] = training.frozen(state.weights)
            frozen = self._frozen[turn]
        done, of = jnp.asarray(state.done), jnp.asarray(total)
        weights, optimiser, loss = training.step(state.weights, state.optimiser, done, of, *frozen)
        return State(weights, optimiser, state.done + 1, loss)


class Bar:
    """A progress bar with the loss; a hook."""

    def __init__(self, name: str, state: State, total: int, *, shown: bool) -> None:
        self._bar = counting(desc=name, initial=state.done, total=total, disable=not shown)

    def __call__(self, state: State, total: int) -> int:
        """Show one step more."""
        self._bar.total = total
        self._bar.update()
        if state.done % _SHOW_EVERY == 0:
            self._bar.set_postfix(loss=f"{float(state.loss):.3e}")
        return total

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


class StepLimit:
    """Sets the number of steps so that training ends at a deadline; a hook.

    A machine becomes busier or less so, and steps become cheaper once the modes are frozen, so the
    number is estimated again and again.

    Parameters
    ----------
    deadline : the time, on the performance counter, at which the last step should end.
    most : the largest number of steps; ``None`` for no limit.
    freeze : the step at which modes are frozen; ``None`` for never.
    """

    def __init__(self, deadline: float, most: int | None = None, freeze: int | None = None) -> None:
        self._deadline = deadline
        self._most = np.iinfo(np.int64).max if most is None else most
        # The first step after freezing compiles; the clock starts after it.
        self._restart = -1 if freeze is None else freeze + 1
        self._began, self._first = time.perf_counter(), 0

    def first_total(self, training: NetworkTraining, total: int) -> int:
        """Return the number of steps to begin with, from a few that are timed and thrown away."""
        fitting = steps_within(self._deadline - time.perf_counter(), training, total)
        self._began = time.perf_counter()
        return min(fitting, self._most)

    def __call__(self, state: State, total: int) -> int:
        """Return the number of steps that follows from the time the last ones took."""
        if state.done == self._restart:
            self._began, self._first = time.perf_counter(), state.done
        elif state.done % _AIM_EVERY == 0:
            jax.block_until_ready(state.loss)
            now = time.perf_counter()
            one = (now - self._began) / (state.done - self._first)
            return min(state.done + max(int((self._deadline - now) / one), 0), self._most)
        return total


def steps_within(seconds: float, training: NetworkTraining, total: int) -> int:
    """Return how many steps fit into ``seconds``; ``total`` sets the learning rates of the trial.

    Raises
    ------
    InputError
        Fewer steps fit than a warm-up takes.
    """
    start_time = time.perf_counter()
    one = late = _seconds_a_step(training, total)
    if training.freeze is not None:
        late = _seconds_a_step(training, total, *training.frozen(training.initial()[0]))
    remaining = 0.98 * seconds - (time.perf_counter() - start_time)
    early = remaining / one
    if training.freeze is not None and late < one:
        early = min(early, training.freeze)
    steps = int(early + max(remaining - early * one, 0.0) / late)
    if steps < WARMUP:
        raise InputError(
            f"the budget leaves {max(steps, 0)} training steps of {1e3 * one:.0f} ms after FEM "
            f"runs and compilation; give at least {WARMUP * one - remaining:.0f} s more"
        )
    return steps


def _seconds_a_step(training: NetworkTraining, total: int, *frozen: jax.Array) -> float:
    """Return the median seconds of a step, compilation excluded."""
    weights, optimiser = training.initial()
    durations = []
    for number in range(_TIMED):
        begin = time.perf_counter()
        weights, optimiser, value = training.step(
            weights, optimiser, jnp.asarray(number), jnp.asarray(total), *frozen
        )
        value.block_until_ready()
        durations.append(time.perf_counter() - begin)
    return float(np.median(durations[1:]))
