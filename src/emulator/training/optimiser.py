"""The optimiser of a network's weights: learning rates, steps, and their loop in a time budget.

:func:`train_network` is the course of a training that recipes with a network have in common.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
from flax import nnx

from emulator.core.checkpoint import Checkpoint
from emulator.core.display import counting
from emulator.core.errors import SolverError
from emulator.fem.campaign import Runs
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network import Network
from emulator.training.job import Job
from emulator.training.plan import Plan
from emulator.training.targets import distance_from_equilibrium

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


class State(NamedTuple):
    """The state between two optimiser steps.

    weights, optimiser : the weights of the network and the state of the optimiser.
    total : the number of steps aimed at.
    done : the number of steps done.
    loss : the loss of the last step.
    """

    weights: Any
    optimiser: Any
    total: int
    done: int = 0
    loss: Any = float("nan")


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
    report : from the loss to the text that shows progress.
    finish : from the weights after the last step, and whether to show progress, to the trained
        weights.
    """

    network: Network
    optimiser: optax.GradientTransformation
    rate: Rate
    descend: Descent
    report: Callable[[float], str] = "loss {:.3e}".format
    finish: Callable[[Weights, bool], Weights] = lambda weights, _: weights

    @cached_property
    def step(self) -> Step:
        """The compiled step."""
        return make_step(self.rate, self.descend, self.optimiser)

    def initial(self, total: int) -> State:
        """Return the state before the first of ``total`` steps, with copies of the weights."""
        weights = jax.tree.map(jnp.copy, self.network.weights)
        return State(weights, self.optimiser.init(weights), total)

    def advance(self, state: State) -> State:
        """Return the state after the next step."""
        done, of = jnp.asarray(state.done), jnp.asarray(state.total)
        weights, optimiser, loss = self.step(state.weights, state.optimiser, done, of)
        return State(weights, optimiser, state.total, state.done + 1, loss)


@dataclass(frozen=True, eq=False)
class PreparedTraining:
    """The training of a network once its FEM runs are there.

    plan : the plan, with as many simulations as were run.
    emulator : the emulator whose network is untrained.
    runs : the FEM solutions, or what sweeps give in their place, the one at the centre first.
    training : the training of the network.
    record : the entries of the emulator's record.
    """

    plan: Any
    emulator: Emulator
    runs: Runs
    training: NetworkTraining
    record: dict[str, Any] = field(default_factory=dict)


def train_network(prepared: PreparedTraining, job: Job, share: float) -> Emulator:
    """Return the emulator whose network is trained, with its record.

    share : the share of a budget after which the last step ends.
    """
    training, deadline = prepared.training, job.deadline(share)
    limit = StepLimit(deadline) if np.isfinite(deadline) else None
    state = run(
        job.checkpoint("steps"),
        training.initial(prepared.plan.steps),
        training.advance,
        limit,
        report=training.report,
        progress=job.progress,
    )
    weights = training.finish(state.weights, job.progress)
    emulator = with_weights(prepared.emulator, weights)
    plan: Plan = replace(prepared.plan, steps=state.done)
    cached = emulator.cache()
    distance = distance_from_equilibrium(
        job.simulator, lambda x: cached(job.scene.from_unit(x)), plan.seed
    )
    record = {**plan.record(state.loss), **prepared.record, "equilibrium": distance}
    return replace(emulator, record=record)


def with_weights(emulator: Emulator, weights: Any) -> Emulator:
    """Return ``emulator`` with other weights of its network."""
    assert emulator.network is not None, "only a network has weights"
    return replace(emulator, network=replace(emulator.network, weights=weights))


def run(
    checkpoint: Checkpoint,
    state: State,
    advance: Callable[[State], State],
    limit: StepLimit | None = None,
    *,
    report: Callable[[float], str] = "loss {:.3e}".format,
    progress: bool,
) -> State:
    """Return the state after all steps, from ``state`` or the checkpoint.

    Raises :class:`SolverError`: the last loss is not finite.
    """
    if (kept := checkpoint.restore(lambda: state)) is not None:
        weights, optimiser = jax.tree.map(jnp.asarray, (kept.weights, kept.optimiser))
        state = kept._replace(weights=weights, optimiser=optimiser)
    with counting(
        desc="steps of the network", initial=state.done, total=state.total, disable=not progress
    ) as bar:
        while state.done < state.total:
            state = advance(state)
            if limit is not None:
                state = state._replace(total=limit(state))
            bar.total = state.total
            bar.update()
            if state.done % _SHOW_EVERY == 0:
                bar.set_postfix_str(report(float(state.loss)))
            checkpoint.keep(lambda: state)  # noqa: B023
    state = state._replace(loss=float(state.loss))
    if not np.isfinite(state.loss):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    checkpoint.write(lambda: state)
    return state


class StepLimit:
    """Sets the number of steps so that training ends at a deadline.

    A machine becomes busier or less so, so the number is estimated again and again, from a tenth of
    the warm-up on.

    deadline : the time, on the performance counter, at which the last step should end.
    """

    def __init__(self, deadline: float) -> None:
        self._deadline = deadline
        self._began, self._first = 0.0, -1

    def __call__(self, state: State) -> int:
        """Return the number of steps that follows from the time the last ones took.

        It is a warm-up's at least: fewer would leave a network that knows nothing.
        """
        steps = state.done - self._first
        if self._first < 0:  # the first step compiles: the clock starts after it
            jax.block_until_ready(state.loss)
            self._began, self._first = time.perf_counter(), state.done
        elif steps == WARMUP // 10 or steps % _AIM_EVERY == 0:
            jax.block_until_ready(state.loss)
            now = time.perf_counter()
            one = (now - self._began) / steps
            return max(state.done + max(int((self._deadline - now) / one), 0), WARMUP)
        return state.total
