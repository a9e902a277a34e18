"""The optimiser of a network's weights: learning rates, steps, and their loop in a time budget."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
from flax import nnx

from emulator.core.display import counting
from emulator.core.errors import InputError, SolverError
from emulator.surrogates.network import Network
from emulator.training.checkpoint import Session, State

WARMUP = 100  # steps in which the learning rate rises
_LENGTH = 1.6  # root mean square of an orthogonal step of a weight; Adam's is up to 1
_SHOW_EVERY = 50  # steps; reading the loss waits for the step to end
_AIM_EVERY = 200  # steps between two estimates of the remaining time

Weights = nnx.State
Step = Callable[..., tuple[Weights, Any, jax.Array]]
Rate = Callable[[jax.Array, jax.Array], jax.Array]
"""``rate(number, total)``: the learning rate of step ``number`` of ``total``."""
Descent = Callable[..., tuple[jax.Array, Weights, Weights]]
"""``descend(weights, number, *data)``: the loss, its gradient, and the weights both belong to."""
Advance = Callable[[State, int], State]
"""One step: from the state and the total number of steps to the next state."""


# ---- learning rates ------------------------------------------------------------------------------
def cosine(peak: float) -> Rate:
    """Return a rate that rises linearly over ``WARMUP`` steps and falls as a cosine to zero."""

    def rate(number: jax.Array, total: jax.Array) -> jax.Array:
        warm = jnp.minimum(1.0, (number + 1) / WARMUP)
        return peak * warm * 0.5 * (1.0 + jnp.cos(jnp.pi * number / total))

    return rate


def halves(peak: float) -> Rate:
    """Return a rate that is ``peak`` in the first half of the steps and a tenth of it after."""
    return lambda number, total: jnp.where(number < total // 2, peak, 0.1 * peak)


# ---- one step ------------------------------------------------------------------------------------
def clipped_adam() -> optax.GradientTransformation:
    """Return Adam on gradients whose norm over all weights is at most 1."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())


def orthogonal_steps() -> optax.GradientTransformation:
    r"""Return steps of equal length in every direction of a layer's weights (Muon, Jordan 2024).

    With the singular values of the momentum's matrix, :math:`M = U \Sigma V^T`, the step of a
    kernel is :math:`U V^T`, scaled to a root mean square of 1.6 a weight: what modes are made of is
    learned by directions whose gradients are small. After 600 steps a ventricle's modes are a
    quarter of the misfit that Adam leaves after 2000. Biases, norms and the branch, which learns
    sooner by it, take Adam's steps (docs/experiments.md, "Orthogonal steps").
    """
    # Rates are negative because the caller subtracts a step.
    muon = optax.contrib.muon(-1.0, adam_learning_rate=-1.0, consistent_rms=_LENGTH)

    def label(path: Any, _: jax.Array) -> str:
        return "branch" if in_branch(path) else "modes"

    by_part = optax.partition(
        {"branch": optax.scale_by_adam(), "modes": muon},
        lambda weights: jax.tree_util.tree_map_with_path(label, weights),
    )
    return optax.chain(optax.clip_by_global_norm(1.0), by_part)


def in_branch(path: Any) -> bool:
    """Return whether a weight at this path belongs to the decoder's branch."""
    return "'branch'" in jax.tree_util.keystr(path)


def make_step(
    rate: Rate,
    descend: Descent,
    optimiser: optax.GradientTransformation,
) -> Step:
    """Return the compiled ``step(weights, state, number, total, *data)``.

    It gives the weights, the optimiser's state and the loss. Batch and learning rate follow from
    ``number`` and ``total`` alone, so that a resumed run repeats them. A step whose gradient is not
    finite changes nothing. The step consumes the weights and the state that it is given.
    """

    def step(
        weights: Weights, state: Any, number: jax.Array, total: jax.Array, *data: Any
    ) -> tuple[Weights, Any, jax.Array]:
        value, gradient, weights = descend(weights, number, *data)
        updates, new_state = optimiser.update(gradient, state, weights)
        size = rate(number, total)
        updates = jax.tree.map(lambda d: (-size * d).astype(d.dtype), updates)
        new = optax.apply_updates(weights, updates), new_state
        finite = jnp.isfinite(optax.tree.norm(gradient))
        weights, state = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, (weights, state))
        return weights, state, value

    return jax.jit(step, donate_argnums=(0, 1))


# ---- many steps ----------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class NetworkTraining:
    """How a network is trained.

    network : the untrained network.
    optimiser, rate, descend : what its steps are made of (:func:`make_step`).
    finish : from the weights after the last step, and whether to show progress, to the trained
        weights.
    """

    network: Network
    optimiser: optax.GradientTransformation
    rate: Rate
    descend: Descent
    finish: Callable[[Weights, bool], Weights] = lambda weights, _: weights

    @cached_property
    def step(self) -> Step:
        """The compiled step."""
        return make_step(self.rate, self.descend, self.optimiser)

    def initial(self) -> State:
        """Return the state before the first step, with copies of the untrained weights."""
        weights = jax.tree.map(jnp.copy, self.network.weights)
        return State(weights, self.optimiser.init(weights))

    def advance(self, state: State, total: int) -> State:
        """Return the state after the next of ``total`` steps."""
        done, of = jnp.asarray(state.done), jnp.asarray(total)
        weights, optimiser, loss = self.step(state.weights, state.optimiser, done, of)
        return State(weights, optimiser, state.done + 1, loss)


def run(
    session: Session,
    state: State,
    total: int,
    advance: Advance,
    limit: StepLimit | None = None,
    *,
    progress: bool,
) -> State:
    """Return the state after all steps, from ``state`` or the checkpoint, and write checkpoints.

    They are written as often as the plan says, and after the last step.

    Raises :class:`SolverError`: the last loss is not finite.
    """
    state, every = session.first(state, total), session.plan.checkpoint_every
    with counting(desc="train", initial=state.done, total=total, disable=not progress) as bar:
        while state.done < total:
            state = advance(state, total)
            bar.total = total = total if limit is None else limit(state, total)
            bar.update()
            if state.done % _SHOW_EVERY == 0:
                bar.set_postfix(loss=f"{float(state.loss):.3e}")
            if state.done % every == 0 or state.done == total:
                session.write(state, total)
    state = state._replace(loss=float(state.loss))
    if not np.isfinite(state.loss):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    return state


class StepLimit:
    """Sets the number of steps so that training ends at a deadline.

    A machine becomes busier or less so, so the number is estimated again and again, from a tenth of
    the warm-up on.

    deadline : the time, on the performance counter, at which the last step should end.
    """

    def __init__(self, deadline: float) -> None:
        self._deadline = deadline
        self._began, self._first = time.perf_counter(), 0

    def __call__(self, state: State, total: int) -> int:
        """Return the number of steps that follows from the time the last ones took.

        :class:`InputError` where fewer steps fit than a warm-up takes.
        """
        if state.done == 1:  # the first step compiles: the clock starts after it
            jax.block_until_ready(state.loss)
            self._began, self._first = time.perf_counter(), state.done
        elif state.done == WARMUP // 10 or state.done % _AIM_EVERY == 0:
            jax.block_until_ready(state.loss)
            now = time.perf_counter()
            one = (now - self._began) / (state.done - self._first)
            total = state.done + max(int((self._deadline - now) / one), 0)
            if total < WARMUP:
                raise InputError(
                    f"the budget leaves {total} training steps of {1e3 * one:.0f} ms after FEM "
                    f"runs and compilation; give at least {(WARMUP - total) * one:.0f} s more"
                )
        return total
