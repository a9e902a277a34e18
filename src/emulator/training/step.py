"""One step of the optimiser, with one pass of the network's processor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from flax import nnx

from emulator.fem.campaign import Runs
from emulator.fem.campaign.designs import uniform
from emulator.surrogates.additive import Emulator
from emulator.training.objectives import Batch
from emulator.training.plan import Plan

WARMUP = 100  # steps
_LENGTH = 1.6  # of an orthogonal step of a weight; Adam's is up to 1

Weights = nnx.State
Step = Callable[..., tuple[Weights, Any, jax.Array]]
Loss = Callable[[jax.Array, Batch], jax.Array]
Descent = Callable[..., tuple[jax.Array, Weights, Weights]]
"""``descend(weights, number, *given)``: loss, its gradient, and the weights that both are of."""
Moves = Callable[..., Weights]
"""``moves(updates, *given)``: the updates that are made."""


def predictor(emulator: Emulator) -> Callable[..., jax.Array]:
    """``predict(weights, thetas, *kept)``: displacement (b, n, 3) in mm at ``thetas`` (b, p).

    The emulator's with other weights of its network. ``kept`` is the decoder's prepared part, and
    without it the processor is run.
    """
    scene, network, series = emulator.scene, emulator.network, emulator.taylor
    assert network is not None, "an emulator in training has a network"

    def predict(weights: Weights, thetas: jax.Array, *kept: jax.Array) -> jax.Array:
        position = scene.to_unit(thetas)
        if kept:
            decoder = nnx.merge(network.definition, weights).decoder
            free = network.decode(decoder, kept[0], position)
        else:
            free = network.predict(weights, position)
        return scene.on_supports(free if series is None else series(position) + free, thetas)

    return predict


def batch_descent(emulator: Emulator, plan: Plan, runs: Runs, loss: Loss) -> Descent:
    """Descent of ``loss`` on batches, each of which follows from the step's number."""
    draw, predict = _batches(emulator, plan, runs), predictor(emulator)

    def descend(
        weights: Weights, number: jax.Array, *kept: jax.Array
    ) -> tuple[jax.Array, Weights, Weights]:
        batch = draw(number)
        misfit = lambda w: loss(predict(w, batch.theta, *kept), batch)  # noqa: E731
        return *jax.value_and_grad(misfit)(weights), weights

    return descend


def clipped_adam() -> optax.GradientTransformation:
    """Adam on gradients whose norm over all weights is at most 1."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())


def orthogonal_steps() -> optax.GradientTransformation:
    r"""Steps of equal length in every direction of a layer's weights (Muon, Jordan et al. 2024).

    With the singular values of the momentum's matrix, :math:`M = U \Sigma V^T`, the step of a
    kernel is :math:`U V^T`, scaled to a root mean square of 1.6 a weight: what modes are made of is
    learned by directions whose gradients are small. After 600 steps a ventricle's modes are a
    quarter of the misfit that Adam leaves after 2000. Biases, norms and the branch, which learns
    sooner by it, take Adam's steps (docs/experiments.md, "Orthogonal steps").
    """
    # Rates are negative since a step is subtracted by whoever takes it.
    muon = optax.contrib.muon(-1.0, adam_learning_rate=-1.0, consistent_rms=_LENGTH)
    ways = {"branch": optax.scale_by_adam(), "modes": muon}

    def way(path: Any, _: jax.Array) -> str:
        return "branch" if in_branch(path) else "modes"

    by_part = optax.partition(ways, lambda w: jax.tree_util.tree_map_with_path(way, w))
    return optax.chain(optax.clip_by_global_norm(1.0), by_part)


def branch_alone(updates: Weights, *kept: jax.Array) -> Weights:
    """``updates``; where the decoder's prepared part is kept, of the branch alone.

    Adam's momentum would otherwise move the weights behind that part.
    """

    def own(path: Any, update: jax.Array) -> jax.Array:
        return update if in_branch(path) else jnp.zeros_like(update)

    return jax.tree_util.tree_map_with_path(own, updates) if kept else updates


def make_step(
    plan: Plan,
    descend: Descent,
    optimiser: optax.GradientTransformation,
    moves: Moves = branch_alone,
) -> Step:
    """``step(weights, state, number, total, *given) -> (weights, state, loss)``, compiled.

    Batch and learning rate follow from ``number`` and ``total`` alone, so that a resumed run
    repeats them. The step consumes the weights and the state it is given.
    """

    def step(
        weights: Weights, state: Any, number: jax.Array, total: jax.Array, *given: Any
    ) -> tuple[Weights, Any, jax.Array]:
        value, gradient, weights = descend(weights, number, *given)
        updates, moved = optimiser.update(gradient, state, weights)
        rate = learning_rate(plan, number, total)
        updates = jax.tree.map(lambda d: (-rate * d).astype(d.dtype), updates)
        updates = moves(updates, *given)
        new = optax.apply_updates(weights, updates), moved
        # A step whose gradient is not finite is not taken.
        finite = jnp.isfinite(optax.tree.norm(gradient))
        weights, state = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, (weights, state))
        return weights, state, value

    return jax.jit(step, donate_argnums=(0, 1))


def _batches(emulator: Emulator, plan: Plan, runs: Runs) -> Callable[[jax.Array], Batch]:
    """The batch of a step, from its number."""

    def draw(number: jax.Array) -> Batch:
        key = jax.random.fold_in(jax.random.key(plan.seed), number)
        if plan.objective == "energy":
            nothing = jnp.zeros(0)
            return Batch(uniform(emulator.scene, plan.batch, key), nothing, nothing)
        rows = jax.random.choice(key, len(runs.theta), (plan.batch,), replace=False)
        return Batch(runs.theta[rows], runs.displacement[rows], runs.energy[rows])

    return draw


def in_branch(path: Any) -> bool:
    """Whether a weight at this path belongs to the decoder's branch."""
    return "'branch'" in jax.tree_util.keystr(path)


def learning_rate(plan: Plan, number: jax.Array, total: jax.Array) -> jax.Array:
    """Learning rate of step ``number`` of ``total``: see :class:`Plan`.

    The cosine follows ``WARMUP`` steps in which the rate rises linearly. Modes and coefficients
    that are learned one after the other have a cosine each.
    """
    peak = plan.learning_rate
    if plan.objective == "modes":
        later = number >= plan.freeze
        total = jnp.where(later, total - plan.freeze, plan.freeze)
        number = jnp.where(later, number - plan.freeze, number)
    if plan.schedule == "halves":
        return jnp.where(number < total // 2, peak, 0.1 * peak)
    warm = jnp.minimum(1.0, (number + 1) / WARMUP)
    return peak * warm * 0.5 * (1.0 + jnp.cos(jnp.pi * number / total))
