"""What all recipes that train a network share: options, the course of a training, and the start.

Encoders, messages and decoders are shared by all nodes, so that their weights fit any mesh (Dalton
et al. 2023, Appendix E): a training may start from the weights of another body's network. Series,
scale and graph belong to one scene and are never carried over. The ranges of the parameters may
differ, because the network takes positions in the unit box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign import Runs
from emulator.fem.energy import require_rest
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network import fresh
from emulator.surrogates.network.graph import augment, node_inputs
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import Expansion
from emulator.training.checkpoint import Record, Session
from emulator.training.optimiser import NetworkTraining, StepLimit, Steps, run
from emulator.training.plan import Job, Plan


@dataclass(frozen=True, eq=False)
class Problem:
    """The training of a network once its FEM runs are there.

    plan : the plan, with as many simulations as were run.
    emulator : the emulator whose network is untrained.
    runs : the FEM solutions, or what sweeps give in their place, the one at the centre first.
    training : the training of the network.
    record : the entries of the emulator's record.
    """

    plan: Plan
    emulator: Emulator
    runs: Runs
    training: NetworkTraining
    record: Record = field(default_factory=dict)


@dataclass(frozen=True)
class NetworkPlan(Plan):
    """The options of all recipes that train a network.

    steps : the number of optimiser steps.
    learning_rate : the largest learning rate.
    checkpoint_every : the number of steps between two checkpoints.
    """

    steps: int = 3000
    learning_rate: float = 1e-3
    checkpoint_every: int = 500

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(1, "steps", "checkpoint_every")
        if not 0.0 < self.learning_rate < math.inf:
            raise InputError(
                f"training: learning_rate is {self.learning_rate}; it must be positive and finite"
            )

    @property
    def budget_share(self) -> float:
        """The share of a budget after which the last step ends."""
        return 0.99

    @property
    def most_steps(self) -> int | None:
        """The largest number of steps that a budget may lead to; ``None`` for no limit."""
        return None

    def prepare(self, job: Job) -> Problem:
        """Return the FEM runs, and an emulator whose network is untrained."""
        raise NotImplementedError

    def complete(self, emulator: Emulator, problem: Problem) -> tuple[Emulator, Record]:  # noqa: ARG002
        """Return the emulator with all that follows the network, and entries of the record."""
        return emulator, {}

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the trained emulator and its record."""
        require_rest(job.scene)  # networks learn from the energy there, or have its modes
        problem = self.prepare(job)
        training, total, limit = problem.training, self.steps, None
        deadline = job.deadline(self.budget_share)
        if np.isfinite(deadline):
            limit = StepLimit(deadline, self.most_steps, training.freeze)
            total = limit.first_total(training, total)
        architecture = training.network.architecture
        session = replace(session, plan=problem.plan, architecture=architecture)
        steps, initial = Steps(training), training.initial()
        state = run(session, initial, total, steps, limit, progress=job.progress)
        record = problem.plan.with_counts(steps=state.done).record(state.loss)
        weights = training.finish(state.weights, job.progress)
        emulator, more = self.complete(with_weights(problem.emulator, weights), problem)
        return emulator, {**record, **problem.record, **more}


def with_weights(emulator: Emulator, weights: Any) -> Emulator:
    """Return ``emulator`` with other weights of its network."""
    assert emulator.network is not None, "only a network has weights"
    return replace(emulator, network=replace(emulator.network, weights=weights))


def with_network_of(emulator: Emulator, start: Emulator | None) -> Emulator:
    """Return ``emulator`` with a copy of the weights of ``start``, if there is one."""
    if start is None:
        return emulator
    assert emulator.network is not None, "only a network has weights"
    assert start.network is not None, "only a network has weights"
    copies = jax.tree.map(jnp.copy, jax.tree.leaves(start.network.weights))
    structure = jax.tree.structure(emulator.network.weights)
    return with_weights(emulator, jax.tree.unflatten(structure, copies))


def untrained(
    plan: Plan,
    job: Job,
    series: Expansion | None,
    architecture: Architecture,
    scale: np.ndarray,
    basis: np.ndarray | None = None,
) -> Emulator:
    """Return the emulator of ``series`` and of a network, with the weights of the start's, if any.

    scale, basis : as in :class:`~emulator.surrogates.network.Network`.
    """
    scene = job.scene
    network = fresh(scene, augment(scene), architecture, scale, plan.seed, basis)
    return with_network_of(Emulator(scene, taylor=series, network=network), job.start)


def architecture_of(
    plan: Plan, job: Job, decoder: Any, usual: Architecture = Architecture(), modes: int = 0
) -> Architecture:
    """Return the sizes of the network to train: those of the start's network, if there is one.

    decoder : the decoder that the recipe prescribes.
    usual : the sizes where the job names none.
    modes : the number of mechanical modes that the decoder is given.

    Raises :class:`InputError`: the start has no network or another architecture, theta or the node
    features differ, or a decoder's coefficients belong to the mechanical modes of one mesh.
    """
    start, scene = job.start, job.scene
    if start is None:
        return replace(job.architecture or usual, decoder=decoder)
    theirs, network = f"the emulator of '{start.scene.name}'", start.network
    if start.family is not None:
        raise InputError(
            f"recipe '{plan.recipe}' cannot start from a network that has learned a family of "
            "bodies; use recipe family or sweeps, without any FEM run, or mechanics"
        )
    if network is None:
        raise InputError(
            f"{theirs} has no network to start from, only {' + '.join(start.parts) or 'nothing'}; "
            "train it with recipe network"
        )
    sizes = replace(job.architecture or network.architecture, decoder=decoder)
    if len(network.basis) or modes:
        raise InputError(
            f"starting '{scene.name}' from {theirs}: coefficients of mechanical modes mean nothing "
            "on another mesh; use a decoder without them, such as recipe network's, for both"
        )
    if sizes != network.architecture:
        raise InputError(
            f"{theirs} has a network {network.architecture}; '{scene.name}' is to have {sizes}"
        )
    if scene.parameter_names != start.scene.parameter_names:
        raise InputError(
            f"{theirs} has parameters {', '.join(start.scene.parameter_names)}; "
            f"'{scene.name}' has {', '.join(scene.parameter_names)}"
        )
    width, ours = network.graph.node_features.shape[1], node_inputs(scene).shape[1]
    if width != ours:
        raise InputError(
            f"{theirs} has {width} features a node, '{scene.name}' has {ours}: one has "
            "supports that move, the other has not"
        )
    return sizes
