"""Recipes that train a network share their options and the course of a training."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from emulator.core.errors import InputError
from emulator.fem.campaign import Runs
from emulator.fem.energy import require_rest
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network import fresh
from emulator.surrogates.network.graph import augment
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import Expansion
from emulator.training.checkpoint import Record, Session
from emulator.training.optimiser import NetworkTraining, StepLimit, run
from emulator.training.plan import Job, Plan


@dataclass(frozen=True, eq=False)
class PreparedTraining:
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

    def prepare(self, job: Job) -> PreparedTraining:
        """Return the FEM runs, and an emulator whose network is untrained."""
        raise NotImplementedError

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the trained emulator and its record."""
        require_rest(job.scene)  # networks learn from the energy there
        problem = self.prepare(job)
        training, deadline = problem.training, job.deadline(self.budget_share)
        limit = StepLimit(deadline) if np.isfinite(deadline) else None
        architecture = training.network.architecture
        session = replace(session, plan=problem.plan, architecture=architecture)
        state, advance = training.initial(), training.advance
        state = run(session, state, self.steps, advance, limit, progress=job.progress)
        record = problem.plan.with_counts(steps=state.done).record(state.loss)
        weights = training.finish(state.weights, job.progress)
        return with_weights(problem.emulator, weights), {**record, **problem.record}


def with_weights(emulator: Emulator, weights: Any) -> Emulator:
    """Return ``emulator`` with other weights of its network."""
    assert emulator.network is not None, "only a network has weights"
    return replace(emulator, network=replace(emulator.network, weights=weights))


def untrained(
    plan: Plan,
    scene: Scene,
    series: Expansion | None,
    architecture: Architecture,
    scale: np.ndarray,
) -> Emulator:
    """Return the emulator of ``series`` and of a network with weights from the plan's seed.

    scale : as in :class:`~emulator.surrogates.network.Network`.
    """
    network = fresh(scene, augment(scene), architecture, scale, plan.seed)
    return Emulator(scene, taylor=series, network=network)
