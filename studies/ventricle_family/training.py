r"""Training one network on FEM runs of many ventricles, so that it predicts on one never seen.

All bodies are padded to equal sizes and given as arguments, so that the step is compiled once. A
step takes one body and all its runs and minimises, lengths relative to the body's size L,

.. math:: \overline{|u - u^*|^2} / s^2
    + \frac1{|\Omega|} \int_\Omega |F(u) - F(u^*)|^2\, dX / s_F^2

over nodes, wall and runs (the objective ``gradients`` of :mod:`emulator.training.objectives`), with
:math:`s` and :math:`s_F` the root mean squares over the family. Edges are turned round at random,
since a message's sign on a mesh unknown follows from the numbering of its nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.core.display import counting
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network import standardised
from emulator.surrogates.network.family import (
    FamilyModule,
    Learned,
    Standard,
    on_body,
    physics_of,
)
from emulator.surrogates.network.graph import AugmentedGraph, BodyFeatures, describe
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import CHECKPOINT, Session, State
from emulator.training.optimiser import clipped_adam, cosine, make_step, run
from emulator.training.plan import Plan

ARCHITECTURE = Architecture(
    steps=4,
    latent=32,
    hidden=(64, 64),
    decoder="separable",
    modes=32,
    trunk=(128, 128),
    branch=(128, 128),
)
"""Sizes of the shipped network."""


@dataclass(frozen=True)
class FamilyPlan(Plan):
    """The options of the training.

    steps, learning_rate : the number of optimiser steps, and the largest learning rate.
    checkpoint_every : the number of steps between two checkpoints.
    """

    recipe: str = "ventricles"
    steps: int = 30_000
    learning_rate: float = 1e-3
    checkpoint_every: int = 500


PLAN = FamilyPlan()
"""The options of the shipped network."""

_LEAST_SD = 1e-6  # a feature that varies less over the family is left at zero


class BodyRuns(NamedTuple):
    """FEM runs of one body. position : (T, p) in the unit box. displacement : (T, n, 3) mm."""

    scene: Scene
    position: np.ndarray
    displacement: np.ndarray


class _Body(NamedTuple):
    """A body as the step takes it: N nodes with virtual ones, n mesh nodes, all padded.

    free : (n, 3), zero where held or padded. share : (n,) of a mean over nodes.
    gradients : (m, 4, 3) of the shape functions, times L. weights : (m,) of the wall's volume.
    position : (T, p). u : (T, n, 3) over L.
    """

    node_features: jax.Array
    edge_features: jax.Array
    senders: jax.Array
    receivers: jax.Array
    vectors: jax.Array
    shares: jax.Array
    free: jax.Array
    share: jax.Array
    elements: jax.Array
    gradients: jax.Array
    weights: jax.Array
    position: jax.Array
    u: jax.Array


@dataclass(frozen=True)
class _Sizes:
    """What bodies are padded to."""

    real: int
    virtual: int
    edges: int
    elements: int


def train_family(
    runs: Sequence[BodyRuns],
    plan: FamilyPlan,
    folder: str | Path,
    home: Scene,
    *,
    architecture: Architecture = ARCHITECTURE,
    progress: bool = False,
    resume: bool = False,
) -> Emulator:
    """Train one network on all ``runs``; the emulator of ``home`` with it.

    Parameters
    ----------
    runs : equally many of each body, of equal parameters and physics.
    plan : the number of steps, learning rate, seed and checkpoints.
    folder : where checkpoints go.
    """
    session = Session(Path(folder) / CHECKPOINT, _check(runs), plan, architecture)
    if resume:
        session = session.resumed(f"{len(runs)} bodies", {plan.recipe: FamilyPlan})
    plan, architecture = cast(FamilyPlan, session.plan), session.architecture or architecture
    described = [describe(r.scene) for r in counting(runs, "describe", disable=not progress)]
    standard = _standard(described)
    sizes = _sizes(runs, described)
    key = np.random.default_rng(plan.seed)
    bodies = [_padded(r, d, standard, sizes, key) for r, d in zip(runs, described, strict=True)]
    scale = float(np.sqrt(np.mean([np.mean(np.asarray(b.u) ** 2) for b in bodies])))
    first = runs[0].scene
    learned = Learned(
        architecture=architecture,
        weights=nnx.State({}),
        standard=standard,
        scale=scale,
        parameters=first.parameters,
        physics=physics_of(first),
        shapes=_ranges(described),
    )
    module = FamilyModule(architecture, learned.widths, plan.seed)
    definition, weights = nnx.split(module)
    optimiser = clipped_adam()
    descend = _descent(definition, scale, _gradient_scale(bodies), sizes.real)
    step = make_step(cosine(plan.learning_rate), descend, optimiser, lambda updates, _: updates)

    def advance(state: State, total: int) -> State:
        body = bodies[_taken(state.done, len(bodies), plan.seed)]
        weights, moments, loss = step(
            state.weights, state.optimiser, jnp.asarray(state.done), jnp.asarray(total), body
        )
        return State(weights, moments, state.done + 1, loss)

    state = State(weights, optimiser.init(weights))
    state = run(session, state, plan.steps, advance, progress=progress)
    record: dict[str, Any] = {
        **plan.record(state.loss),
        "bodies": len(runs),
        "seconds": round(session.seconds, 1),
    }
    part = on_body(learned._replace(weights=state.weights), home)
    return Emulator(home, family=part, record=record)


def _taken(done: int, count: int, seed: int) -> int:
    """Which of ``count`` bodies a step takes: all of them, in an order of its own each epoch."""
    epoch, place = divmod(done, count)
    return int(np.random.default_rng((seed, epoch)).permutation(count)[place])


def _check(runs: Sequence[BodyRuns]) -> str:
    """Fingerprint of all bodies; :class:`InputError` where they do not belong together."""
    if not runs:
        raise InputError("a family: no body is given")
    first = runs[0]
    for each in runs:
        if (
            each.scene.space != first.scene.space
            or physics_of(each.scene) != physics_of(first.scene)
            or each.position.shape != first.position.shape
        ):
            raise InputError(
                f"a family: '{each.scene.name}' has other parameters, physics or number of runs "
                "than the first body"
            )
    return "+".join(each.scene.fingerprint for each in runs)


def _standard(described: Sequence[BodyFeatures]) -> Standard:
    """Means and deviations of all features over all bodies."""
    nodes = np.concatenate([body.graph.node_features for body in described])
    edges = np.concatenate([body.graph.edge_features for body in described])
    edges = np.concatenate([edges, -edges * [1.0, 1.0, 1.0, -1.0]])  # either way round
    return Standard(nodes.mean(axis=0), _sd(nodes), edges.mean(axis=0), _sd(edges))


def _sd(values: np.ndarray) -> np.ndarray:
    sd = values.std(axis=0)
    return np.where(sd > _LEAST_SD, sd, np.inf)


def _ranges(described: Sequence[BodyFeatures]) -> dict[str, tuple[float, float]]:
    """Range of each number that a whole body has."""
    found = {name: [body.shape[name] for body in described] for name in described[0].shape}
    return {name: (min(values), max(values)) for name, values in found.items()}


def _sizes(runs: Sequence[BodyRuns], described: Sequence[BodyFeatures]) -> _Sizes:
    graphs = [body.graph for body in described]
    return _Sizes(
        real=max(graph.real for graph in graphs),
        virtual=max(len(graph.node_features) - graph.real for graph in graphs) + 1,
        edges=max(len(graph.senders) for graph in graphs),
        elements=max(len(each.scene.mesh.elements) for each in runs),
    )


def _padded(
    runs: BodyRuns,
    body: BodyFeatures,
    standard: Standard,
    sizes: _Sizes,
    generator: np.random.Generator,
) -> _Body:
    """``runs`` and the network's features, padded. The last virtual node belongs to no body."""
    scene, told, graph = runs.scene, body.graph, standard.of(body.graph)
    size = body.shape["size"]
    total, real = sizes.real + sizes.virtual, told.real
    features = np.zeros((total, graph.node_features.shape[1]), np.float32)
    features[:real] = graph.node_features[:real]
    features[sizes.real : sizes.real + len(told.node_features) - real] = graph.node_features[real:]
    place = np.where(np.arange(len(told.node_features)) < real, 0, sizes.real - real)
    ends = np.full((2, sizes.edges), total - 1, np.int32)
    turned = generator.random(len(told.edge_features)) < 0.5
    pair = np.stack([told.senders, told.receivers])
    pair = pair + place[pair]
    ends[:, : len(told.edge_features)] = np.where(turned, pair[::-1], pair)
    signs = np.where(turned[:, None], [-1.0, -1.0, -1.0, 1.0], 1.0)
    edges = np.zeros((sizes.edges, 4), np.float32)
    edges[: len(told.edge_features)] = (
        signs * told.edge_features - standard.edge_mean
    ) / standard.edge_sd
    grid = scene.discretisation
    weights = grid.weights.sum(axis=1)
    free = (~scene.held).astype(np.float32)

    def filled(values: np.ndarray, count: int, axis: int = 0) -> np.ndarray:
        width = [(0, 0)] * values.ndim
        width[axis] = (0, count - values.shape[axis])
        kind = np.int32 if np.issubdtype(values.dtype, np.integer) else np.float32
        return np.pad(values, width).astype(kind)

    return _Body(
        node_features=jnp.asarray(features),
        edge_features=jnp.asarray(edges),
        senders=jnp.asarray(ends[0]),
        receivers=jnp.asarray(ends[1]),
        vectors=jnp.asarray(filled(body.vectors / size, sizes.real)),
        shares=jnp.asarray(filled(body.shares, sizes.real)),
        free=jnp.asarray(filled(free, sizes.real)),
        share=jnp.asarray(filled(np.full(real, 1.0 / real), sizes.real)),
        elements=jnp.asarray(filled(grid.connectivity, sizes.elements)),
        gradients=jnp.asarray(filled(grid.gradients[:, 0] * size, sizes.elements)),
        weights=jnp.asarray(filled(weights / weights.sum(), sizes.elements)),
        position=jnp.asarray(runs.position),
        u=jnp.asarray(filled(runs.displacement / size, sizes.real, axis=1)),
    )


def _gradient(body: _Body, field: jax.Array) -> jax.Array:
    """Gradient (T, m, 3, 3) of ``field`` (T, n, 3) over L."""
    return jnp.einsum("tmai,maj->tmij", field[:, body.elements], body.gradients)


def _mean_square_gradient(body: _Body, field: jax.Array) -> jax.Array:
    squares = jnp.sum(_gradient(body, field) ** 2, axis=(-2, -1))
    return jnp.mean(squares @ body.weights)


def _gradient_scale(bodies: Sequence[_Body]) -> float:
    """Root mean square over the family of the gradients' size."""
    square = jax.jit(lambda body: _mean_square_gradient(body, body.u))
    return float(np.sqrt(np.mean([float(square(body)) for body in bodies])))


def _descent(
    definition: Any, scale: float, gradient_scale: float, real: int
) -> Callable[..., tuple[jax.Array, Any, Any]]:
    """``descend(weights, number, body)``: loss, its gradient and the weights."""

    def loss(weights: Any, body: _Body) -> jax.Array:
        module: FamilyModule = nnx.merge(definition, weights)
        nodes, edges, senders, receivers, *_ = cast(tuple[Any, ...], body)  # traced
        graph = AugmentedGraph(nodes, edges, senders, receivers, real)
        modes, mean = module.prepare(graph, body.vectors, body.shares)
        coefficients = module.branch(standardised(body.position), mean)
        u = scale * jnp.tensordot(coefficients, modes, axes=1) * body.free
        wrong = u - body.u
        misfit = jnp.mean(jnp.sum(wrong**2, axis=-1) @ body.share) / (3.0 * scale**2)
        return misfit + _mean_square_gradient(body, wrong) / gradient_scale**2

    def descend(weights: Any, _: jax.Array, body: _Body) -> tuple[jax.Array, Any, Any]:
        return *jax.value_and_grad(loss)(weights, body), weights

    return descend
