"""One step of the optimiser: learning rates, optimisers, and the compiled step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from flax import nnx

WARMUP = 100  # steps in which the learning rate rises
_LENGTH = 1.6  # root mean square of an orthogonal step of a weight; Adam's is up to 1

Weights = nnx.State
Step = Callable[..., tuple[Weights, Any, jax.Array]]
Rate = Callable[[jax.Array, jax.Array], jax.Array]
"""``rate(number, total)``: the learning rate of step ``number`` of ``total``."""
Descent = Callable[..., tuple[jax.Array, Weights, Weights]]
"""``descend(weights, number, *frozen)``: the loss, its gradient, and the weights both belong to."""
Restriction = Callable[..., Weights]
"""``restrict(updates, *frozen)``: the updates that are made."""


def cosine(peak: float) -> Rate:
    """Return a rate that rises linearly over ``WARMUP`` steps and falls as a cosine to zero."""

    def rate(number: jax.Array, total: jax.Array) -> jax.Array:
        warm = jnp.minimum(1.0, (number + 1) / WARMUP)
        return peak * warm * 0.5 * (1.0 + jnp.cos(jnp.pi * number / total))

    return rate


def two_cosines(peak: float, switch: int) -> Rate:
    """Return a :func:`cosine` up to step ``switch`` and another one from there on."""
    one = cosine(peak)

    def rate(number: jax.Array, total: jax.Array) -> jax.Array:
        later = number >= switch
        total = jnp.where(later, total - switch, switch)
        return one(jnp.where(later, number - switch, number), total)

    return rate


def halves(peak: float) -> Rate:
    """Return a rate that is ``peak`` in the first half of the steps and a tenth of it after."""
    return lambda number, total: jnp.where(number < total // 2, peak, 0.1 * peak)


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


def branch_alone(updates: Weights, *frozen: jax.Array) -> Weights:
    """Return ``updates``; once the modes are ``frozen``, only updates of the branch.

    Adam's momentum would otherwise move the weights that the frozen modes came from.
    """

    def own(path: Any, update: jax.Array) -> jax.Array:
        return update if in_branch(path) else jnp.zeros_like(update)

    return jax.tree_util.tree_map_with_path(own, updates) if frozen else updates


def make_step(
    rate: Rate,
    descend: Descent,
    optimiser: optax.GradientTransformation,
    restrict: Restriction = branch_alone,
) -> Step:
    """Return the compiled ``step(weights, state, number, total, *frozen)``.

    It gives the weights, the optimiser's state and the loss. Batch and learning rate follow from
    ``number`` and ``total`` alone, so that a resumed run repeats them. A step whose gradient is not
    finite changes nothing. The step consumes the weights and the state that it is given.
    """

    def step(
        weights: Weights, state: Any, number: jax.Array, total: jax.Array, *frozen: Any
    ) -> tuple[Weights, Any, jax.Array]:
        value, gradient, weights = descend(weights, number, *frozen)
        updates, new_state = optimiser.update(gradient, state, weights)
        size = rate(number, total)
        updates = jax.tree.map(lambda d: (-size * d).astype(d.dtype), updates)
        new = optax.apply_updates(weights, restrict(updates, *frozen)), new_state
        finite = jnp.isfinite(optax.tree.norm(gradient))
        weights, state = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, (weights, state))
        return weights, state, value

    return jax.jit(step, donate_argnums=(0, 1))
