"""The loop of optimiser steps, for one scene or several; everything else is a hook."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from emulator.errors import SolverError
from emulator.training.checkpoint import State, Writer
from emulator.training.plan import Plan
from emulator.training.problem import Problem

Advance = Callable[[State, int], State]
"""One step: state and total number of steps to the next state."""
Hook = Callable[[State, int], int]
"""Called after each step with the state and the total; returns the total from there on."""

_SHOW_EVERY = 50  # steps; reading the loss waits for the step to end


def optimise(state: State, total: int, advance: Advance, hooks: Sequence[Hook]) -> State:
    """Steps until ``total`` are done, which a hook may change."""
    while state.done < total:
        state = advance(state, total)
        for hook in hooks:
            total = hook(state, total)
    return state


class Steps:
    """One step after another of several problems in turn, their weights in common.

    After ``freeze`` steps of a separable decoder, what these have learned is computed once and
    kept.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        self._problems = problems
        self._kept: dict[int, tuple[jax.Array, ...]] = {}

    def __call__(self, state: State, total: int) -> State:
        """The next step."""
        turn = state.done % len(self._problems)
        problem = self._problems[turn]
        assert problem.step is not None, "only a network has steps"
        plan = problem.plan
        kept: tuple[jax.Array, ...] = ()
        if plan.decoder == "separable" and state.done >= plan.freeze:
            kept = self._keep(turn, state)
        done, of = jnp.asarray(state.done), jnp.asarray(total)
        weights, optimiser, loss = problem.step(state.weights, state.optimiser, done, of, *kept)
        return State(weights, optimiser, state.done + 1, loss)

    def _keep(self, turn: int, state: State) -> tuple[jax.Array, ...]:
        """What problem ``turn`` keeps; no later step changes it."""
        if turn not in self._kept:
            self._kept[turn] = self._problems[turn].keep(state.weights)
        return self._kept[turn]


class Bar:
    """A progress bar with the loss; a hook."""

    def __init__(self, name: str, state: State, total: int, *, shown: bool) -> None:
        self._bar = tqdm(desc=name, initial=state.done, total=total, disable=not shown)

    def __call__(self, state: State, total: int) -> int:
        """One step further."""
        self._bar.total = total
        self._bar.update()
        if state.done % _SHOW_EVERY == 0:
            self._bar.set_postfix(loss=f"{float(state.loss):.3e}")
        return total

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


class Keep:
    """Writes checkpoints as often as the plan says, and after the last step; a hook."""

    def __init__(self, writer: Writer, plan: Plan, clock: Callable[[], float]) -> None:
        self._writer, self._plan, self._clock = writer, plan, clock

    def __call__(self, state: State, total: int) -> int:
        """A checkpoint, if one is due."""
        if state.done % self._plan.checkpoint_every == 0 or state.done == total:
            self.write(state, total)
        return total

    def write(self, state: State, total: int) -> None:
        """A checkpoint with the number of steps aimed at."""
        self._writer.write(state, replace(self._plan, steps=total), self._clock())


def require_finite(state: State) -> float:
    """The last loss; :class:`SolverError` where it is not finite."""
    loss = float(state.loss)
    if not np.isfinite(loss):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    return loss
