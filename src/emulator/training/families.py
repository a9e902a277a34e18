r"""A family: one network trained on FEM runs of many ventricles, for one that it has never seen.

A room, with the networks.

A step takes one body and all its runs: displacements u and their slopes in the unit box. With the
error e of either, lengths over the body's size L, it minimises the mean over runs of

.. math::
    w \Big[ \overline{|e|^2} / s^2 + 5\, \Big(\oint e \cdot n\, da\Big)^2 / s_V^2
    + \tfrac12 \frac1{|\Omega|} \int_\Omega |\nabla e|^2\, dX / s_F^2 \Big],
    \qquad w = \frac{1}{0.09 + \overline{|u|^2} / s^2}

over nodes and components, the deformed endocardium and the wall, plus 0.15 times the first two of
each slope. The scales s are root mean squares over the family: the weights w make errors count
relative to the motion, but not of runs that hardly move. All bodies are padded to equal sizes, so
that the step is compiled once. Edges are turned round at random, since a message's sign on a mesh
unknown follows from the numbering of its nodes.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError
from emulator.fem.linear_response import pressure_force
from emulator.geometry.discretisation import shapes_at
from emulator.geometry.mesh import Mesh
from emulator.mechanics.kinematics import cofactor
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.body import BodyFeatures, describe
from emulator.surrogates.network.family import (
    FamilyEnsemble,
    FamilyModule,
    FamilyNetwork,
    Inputs,
    Standard,
    physics_of,
)
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import Architecture
from emulator.training.optimiser import State, cosine, make_step, orthogonal_steps, run
from emulator.training.plan import Plan

ARCHITECTURE = Architecture(
    steps=3,
    latent=48,
    hidden=(64, 64),
    decoder="separable",
    modes=32,
    trunk=(128, 128),
    branch=(192, 192),
)
"""Sizes of the shipped network."""


@dataclass(frozen=True)
class FamilyPlan(Plan):
    """The options of the training; by default those of the shipped network.

    steps, learning_rate : the number of optimiser steps, and the largest learning rate.
    """

    recipe: str = "ventricles"
    steps: int = 20_000
    learning_rate: float = 7e-4


CAVITY, PRESSURE = "endocardium", "pressure"
_LEAST_SD = 1e-6  # a feature that varies less over the family is left at zero
_STILL, _GRADIENT, _VOLUME, _SLOPE = 0.09, 0.5, 5.0, 0.15  # the numbers of the loss


class BodyRuns(NamedTuple):
    """FEM runs of one body.

    features : the body as a network is told of it. mesh : its mesh. held : (n,) nodes.
    position : (T, p) in the unit box. displacement : (T, n, 3) mm. slopes : (T, p, n, 3) mm.
    """

    features: BodyFeatures
    mesh: Mesh
    held: np.ndarray
    position: np.ndarray
    displacement: np.ndarray
    slopes: np.ndarray


class _Body(NamedTuple):
    """A body as the step takes it.

    inputs : as the network takes it, vectors over L; its graph as a dictionary.
    free : (n,), zero where held. share : (n,) of a mean over nodes. position : (T, p).
    fields : (T, 1 + p, n, 3) the displacements, then their slopes, over s L.
    elements : (m, a). gradients : (m, a, 3) at the centroids, so that those of fields are over s_F.
    weights : (m,) of the wall's volume.
    growth : (T, n, 3) derivatives of the cavity's volume, so that its changes are over s_V L^3.
    """

    inputs: Any
    free: Any
    share: Any
    elements: Any
    gradients: Any
    weights: Any
    growth: Any
    position: Any
    fields: Any


def standard_of(bodies: Sequence[BodyFeatures]) -> Standard:
    """Means and deviations of all features over all bodies."""
    edges = np.concatenate([body.graph.edge_features for body in bodies])
    edges = np.concatenate([edges, -edges * [1.0, 1.0, 1.0, -1.0]])  # either way round
    return Standard(
        _moments(np.concatenate([body.graph.node_features for body in bodies])),
        _moments(edges),
        _moments(np.concatenate([body.local for body in bodies])),
        _moments(np.array([list(body.numbers.values()) for body in bodies])),
    )


def _moments(values: np.ndarray) -> np.ndarray:
    sd = values.std(axis=0)
    return np.stack([values.mean(axis=0), np.where(sd > _LEAST_SD, sd, np.inf)])


class _Sizes(NamedTuple):
    """What bodies are padded to: regions, virtual nodes, edges, nodes and elements."""

    regions: int
    virtual: int
    edges: int
    nodes: int
    elements: int

    @classmethod
    def of(cls, runs: Sequence[BodyRuns]) -> _Sizes:
        """The largest of all; a virtual node more, for spare edges."""
        graphs = [body.features.graph for body in runs]
        return cls(
            regions=max(graph.real for graph in graphs),
            virtual=max(len(graph.node_features) - graph.real for graph in graphs) + 1,
            edges=max(len(graph.senders) for graph in graphs),
            nodes=max(len(body.features.local) for body in runs),
            elements=max(len(body.mesh.elements) for body in runs),
        )


def _padded(values: np.ndarray, count: int, axis: int = 0) -> np.ndarray:
    """``values`` with zeros after them, ``count`` along ``axis``; float32 or int32."""
    width = [(0, 0)] * values.ndim
    width[axis] = (0, count - values.shape[axis])
    kind = np.int32 if np.issubdtype(values.dtype, np.integer) else np.float32
    return np.pad(values, width).astype(kind)


def _graph(
    features: BodyFeatures, standard: Standard, sizes: _Sizes, generator: np.random.Generator
) -> dict[str, np.ndarray]:
    """The graph, its edges turned round at random, padded after regions and virtual nodes."""
    graph, real = standard.of(features).graph, features.graph.real
    regions, above = graph.node_features[:real], graph.node_features[real:]
    nodes = [_padded(regions, sizes.regions), _padded(above, sizes.virtual)]
    pair = np.stack([graph.senders, graph.receivers])
    pair = pair + np.where(pair < real, 0, sizes.regions - real)
    turned = np.asarray(generator.random(pair.shape[1])) < 0.5
    signs = np.where(turned[:, None], [-1.0, -1.0, -1.0, 1.0], 1.0)
    edges = (signs * features.graph.edge_features - standard.edge[0]) / standard.edge[1]
    ends = np.full((2, sizes.edges), sizes.regions + sizes.virtual - 1, np.int32)
    ends[:, : pair.shape[1]] = np.where(turned, pair[::-1], pair)
    return {
        "node_features": np.concatenate(nodes),
        "edge_features": _padded(edges, sizes.edges),
        "senders": ends[0],
        "receivers": ends[1],
    }


def _prepared(
    runs: BodyRuns, standard: Standard, sizes: _Sizes, generator: np.random.Generator
) -> _Body:
    """``runs`` as the step takes them, lengths over L, padded."""
    mesh, size = runs.mesh, runs.features.size
    inputs = standard.of(runs.features)
    nodes = mesh.nodes / size
    slopes = shapes_at(mesh.order, np.full((1, 4), 0.25))[1][0]
    jacobian = np.einsum("mai,aj->mij", nodes[mesh.elements], slopes)
    volumes = np.linalg.det(jacobian)
    inverse = np.swapaxes(jax.vmap(cofactor)(jacobian), 1, 2) / volumes[:, None, None]
    gradients = np.einsum("aj,mji->mai", slopes, inverse)
    growth = [pressure_force(mesh, mesh.nodes + u, CAVITY) for u in runs.displacement]
    fields = np.concatenate([runs.displacement[:, None], runs.slopes], axis=1) / size
    count = len(nodes)
    return _Body(
        inputs=Inputs(
            graph=cast(Any, _graph(runs.features, standard, sizes, generator)),
            local=_padded(inputs.local, sizes.nodes),
            near=_padded(inputs.near, sizes.nodes),
            closeness=_padded(inputs.closeness, sizes.nodes),
            vectors=_padded(inputs.vectors / size, sizes.nodes),
            shares=_padded(inputs.shares, sizes.regions),
            numbers=inputs.numbers,
        ),
        free=_padded(~runs.held, sizes.nodes),
        share=_padded(np.full(count, 1.0 / (3.0 * count)), sizes.nodes),
        elements=_padded(mesh.elements, sizes.elements),
        gradients=_padded(gradients, sizes.elements),
        weights=_padded(volumes / volumes.sum(), sizes.elements),
        growth=_padded(np.array(growth) / size**2, sizes.nodes, axis=1),
        position=runs.position.astype(np.float32),
        fields=_padded(fields, sizes.nodes, axis=2),
    )


def _in_scales(body: _Body, scales: tuple[float, float, float]) -> _Body:
    """``body``, prepared with lengths over L, in the units of the scales."""
    s, s_F, s_V = scales
    return body._replace(
        fields=body.fields / np.float32(s),
        gradients=body.gradients * np.float32(s / s_F),
        growth=body.growth * np.float32(s / s_V),
    )


class Family(NamedTuple):
    """All that a training needs of its bodies.

    bodies : as the step takes them. learned : the network, untrained, on no body.
    """

    bodies: list[_Body]
    learned: FamilyEnsemble


def family_of(
    runs: Sequence[BodyRuns], home: Scene, architecture: Architecture = ARCHITECTURE, seed: int = 0
) -> Family:
    """The family of ``runs``, of the physics and the box of ``home``.

    :class:`InputError` where there is none, where bodies have unlike runs, or where the box does
    not begin without pressure.
    """
    if not runs:
        raise InputError("a family: no body is given")
    if len({body.position.shape for body in runs}) > 1:
        raise InputError("a family: its bodies have other numbers of runs than the first")
    if next(p.low for p in home.parameters if p.name == PRESSURE):
        raise InputError(f"a family: the range of its {PRESSURE} does not begin at zero")
    standard = standard_of([body.features for body in runs])
    rng, sizes = np.random.default_rng(seed), _Sizes.of(runs)
    bodies = [_prepared(body, standard, sizes, rng) for body in runs]
    names = runs[0].features.shape
    numbers = np.array([list(body.features.shape.values()) for body in runs])
    ranges = zip(numbers.min(axis=0).tolist(), numbers.max(axis=0).tolist(), strict=True)
    scales = _scales(bodies)
    learned = FamilyEnsemble(
        architecture=architecture,
        members=(),
        standard=standard,
        scale=scales[0],
        parameters=home.parameters,
        pressure=PRESSURE,
        physics=physics_of(home, home.parameters),
        shapes=dict(zip(names, ranges, strict=True)),
    )
    return Family([_in_scales(body, scales) for body in bodies], learned)


def _scales(bodies: Sequence[_Body]) -> tuple[float, float, float]:
    """Root mean squares over the family: of a component of u, of its gradient, of the volume."""

    def squares(body: _Body) -> list[float]:
        u = body.fields[:, 0]
        slopes = np.einsum("tmai,maj->tmij", u[:, body.elements], body.gradients)
        grown = np.einsum("tni,tni->t", body.growth, u)
        slope = np.mean(np.sum(slopes**2, axis=(2, 3)) @ body.weights)
        return [
            float(np.mean(np.sum(u**2, axis=2) @ body.share)),
            float(slope),
            float(np.mean(grown**2)),
        ]

    scales = np.sqrt(np.mean([squares(body) for body in bodies], axis=0))
    return tuple(scales.tolist())


def errors(module: FamilyModule, body: _Body, pressure: int) -> jax.Array:
    """The errors (T, 1 + p, n, 3) of displacements and slopes, over s L.

    pressure : which entry of theta the pressure is.
    """
    inputs: Inputs = body.inputs
    inputs = inputs._replace(
        graph=AugmentedGraph(**cast(Any, inputs.graph), real=len(inputs.shares))
    )
    modes, summary = module.prepare(inputs)
    along = lambda x: module.coefficients(x, inputs.numbers, summary, pressure)  # noqa: E731
    values = along(body.position)[:, None]
    slopes = jnp.moveaxis(jax.vmap(jax.jacfwd(along))(body.position), -1, 1)
    coefficients = jnp.concatenate([values, slopes], axis=1)
    return jnp.tensordot(coefficients, modes, axes=1) * body.free[:, None] - body.fields


def loss_of(module: FamilyModule, body: _Body, pressure: int) -> jax.Array:
    """The loss of one body."""
    e = errors(module, body, pressure)
    gradients = jnp.einsum("tmai,maj->tmij", e[:, 0, body.elements], body.gradients)
    rough = jnp.sum(gradients**2, axis=(-2, -1)) @ body.weights
    volume = jnp.einsum("tni,tkni->tk", body.growth, e) ** 2
    misfit = jnp.sum(e**2, axis=3) @ body.share + _VOLUME * volume
    misfit = misfit[:, 0] + _GRADIENT * rough + _SLOPE * jnp.sum(misfit[:, 1:], axis=1)
    motion = jnp.sum(body.fields[:, 0] ** 2, axis=2) @ body.share
    return jnp.mean(misfit / (_STILL + motion))


def train_family(
    family: Family,
    fingerprint: str,
    plan: FamilyPlan,
    folder: str | Path,
    home: Scene,
    *,
    progress: bool = False,
    resume: bool = False,
    after_step: Callable[[State, int], None] = lambda *_: None,
) -> Emulator:
    """Train one network on ``family``; the emulator of ``home`` with it.

    fingerprint : the digest of the bodies' runs, by which a checkpoint is found to be theirs.
    folder : where checkpoints go. after_step : called with the state and the number of steps.
    """
    learned, bodies = family.learned, family.bodies
    identity = {"bodies": fingerprint, "plan": asdict(plan)}
    checkpoint = Checkpoint(Path(folder) / "steps.safetensors", identity)
    if not resume:
        checkpoint.remove()
    began = time.perf_counter()
    module = FamilyModule(learned.architecture, learned.widths, plan.seed)
    definition, weights = nnx.split(module)
    step = make_step(
        cosine(plan.learning_rate),
        _descent(definition, family),
        orthogonal_steps(),
    )

    def advance(state: State) -> State:
        body = bodies[_taken(state.done, len(bodies), plan.seed)]
        numbers = jnp.asarray(state.done), jnp.asarray(state.total)
        weights, moments, loss = step(state.weights, state.optimiser, *numbers, body)
        state = State(weights, moments, state.total, state.done + 1, loss)
        after_step(state, state.total)
        return state

    state = State(weights, orthogonal_steps().init(weights), plan.steps)
    state = run(checkpoint, state, advance, progress=progress)
    record: dict[str, Any] = {
        **plan.record(state.loss),
        "bodies": len(bodies),
        "seconds": round(time.perf_counter() - began, 1),
    }
    part = FamilyNetwork(learned._replace(members=(state.weights,)), home)
    return Emulator(home, family=part, record=record)


def _taken(done: int, count: int, seed: int) -> int:
    """Which of ``count`` bodies a step takes: all of them, in another order in every epoch."""
    epoch, place = divmod(done, count)
    return int(np.random.default_rng((seed, epoch)).permutation(count)[place])


def _descent(definition: Any, family: Family) -> Callable[..., tuple[jax.Array, Any, Any]]:
    """``descend(weights, number, body)``: loss, its gradient and the weights."""
    pressure = family.learned.space.names.index(family.learned.pressure)

    def loss(weights: Any, body: _Body) -> jax.Array:
        return loss_of(nnx.merge(definition, weights), body, pressure)

    def descend(weights: Any, _: jax.Array, body: _Body) -> tuple[jax.Array, Any, Any]:
        return *jax.value_and_grad(loss)(weights, body), weights

    return descend


def digest_of(runs: Iterable[BodyRuns]) -> str:
    """A digest of the runs."""
    digest = hashlib.sha256()
    for body in runs:
        digest.update(np.ascontiguousarray(body.displacement).tobytes())
    return digest.hexdigest()[:16]


def ensemble(trained: Sequence[Emulator], record: dict[str, Any]) -> Emulator:
    """Return the emulator whose networks are those of ``trained``, of one family and one home."""
    parts = [cast(FamilyNetwork, emulator.family) for emulator in trained]
    members = tuple(weights for part in parts for weights in part.learned.members)
    part = FamilyNetwork(parts[0].learned._replace(members=members), trained[0].scene)
    return Emulator(trained[0].scene, family=part, record=record)


def median_error(trained: Emulator, runs: BodyRuns, least_pressure: float = 0.33) -> float:
    r"""Return the median of \|u - u_FEM\| in mm over nodes and runs of one body.

    least_pressure : the position in the box's range of pressure from which runs count.
    """
    learned = cast(FamilyNetwork, trained.family).learned
    definition, _ = nnx.split(learned.outline)
    body = learned.standard.of(runs.features)
    which = learned.space.names.index(learned.pressure)
    loaded = runs.position[:, which] > least_pressure
    if not loaded.any():
        return float("nan")
    position, u = jnp.asarray(runs.position[loaded]), np.zeros(())
    for weights in learned.members:
        module = nnx.merge(definition, weights)
        modes, summary = module.prepare(body)
        coefficients = module.coefficients(position, body.numbers, summary, which)
        u = u + np.tensordot(coefficients, modes, axes=1) * learned.scale / len(learned.members)
    u = u * ~runs.held[:, None]
    return float(np.median(np.linalg.norm(u - runs.displacement[loaded], axis=-1)))


__all__ = [
    "BodyRuns",
    "Family",
    "FamilyPlan",
    "describe",
    "digest_of",
    "ensemble",
    "family_of",
    "median_error",
    "train_family",
]
