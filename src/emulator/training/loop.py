"""The loop of optimiser steps, for one scene or several; everything else is a hook."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import SolverError
from emulator.core.progress import counting
from emulator.training.checkpoint import Session, State
from emulator.training.network import NetworkTraining

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
    """All steps of a training, from ``state`` or from its checkpoint, and checkpoints of them."""
    state = session.first(state, total)
    with Bar(name, state, total, shown=progress) as bar:
        return optimise(state, total, advance, [*hooks, bar, session])


class Steps:
    """One step after another of several networks in turn, their weights in common.

    After ``freeze`` steps of a separable decoder, what these have learned is computed once and
    kept.
    """

    def __init__(self, trainings: Sequence[NetworkTraining]) -> None:
        self._trainings = trainings
        self._kept: dict[int, tuple[jax.Array, ...]] = {}

    def __call__(self, state: State, total: int) -> State:
        """The next step."""
        turn = state.done % len(self._trainings)
        training = self._trainings[turn]
        plan = training.plan
        kept: tuple[jax.Array, ...] = ()
        if plan.decoder == "separable" and state.done >= plan.freeze:
            kept = self._keep(turn, state)
        done, of = jnp.asarray(state.done), jnp.asarray(total)
        weights, optimiser, loss = training.step(state.weights, state.optimiser, done, of, *kept)
        return State(weights, optimiser, state.done + 1, loss)

    def _keep(self, turn: int, state: State) -> tuple[jax.Array, ...]:
        """What network ``turn`` keeps; no later step changes it."""
        if turn not in self._kept:
            self._kept[turn] = self._trainings[turn].keep(state.weights)
        return self._kept[turn]


class Bar:
    """A progress bar with the loss; a hook."""

    def __init__(self, name: str, state: State, total: int, *, shown: bool) -> None:
        self._bar = counting(desc=name, initial=state.done, total=total, disable=not shown)

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


def require_finite(state: State) -> float:
    """The last loss; :class:`SolverError` where it is not finite."""
    loss = float(state.loss)
    if not np.isfinite(loss):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    return loss
