"""Recipes ``network`` and ``paper``: the graph network of Dalton et al. (2023), Algorithm 1.

``network`` adds it to the FEM solution at the centre of the box and trains it on FEM runs and the
energy. ``paper`` trains it from zero on the energy at one theta a step, by Adam at 1e-4 and then
1e-5, as the released code does. Recipe ``hybrid`` takes batches of theta by the same functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Runs
from emulator.fem.campaign.designs import uniform
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import constant
from emulator.training.network_plan import NetworkPlan, Problem, architecture_of, untrained
from emulator.training.objectives import (
    OBJECTIVES,
    Objective,
    component_scales,
    loss_scales,
    make_loss,
)
from emulator.training.optimiser import (
    NetworkTraining,
    Rate,
    Weights,
    clipped_adam,
    cosine,
    halves,
)
from emulator.training.plan import Job


@dataclass(frozen=True)
class BatchPlan(NetworkPlan):
    """The options of recipes that minimise an objective over batches of theta.

    objective : what is minimised (:mod:`~emulator.training.objectives`).
    simulations : the number of FEM runs.
    batch : the number of theta a step.
    """

    objective: Objective = "both"
    simulations: int = 256
    batch: int = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.objective not in OBJECTIVES:
            *first, last = OBJECTIVES
            raise InputError(f"objective '{self.objective}': use {', '.join(first)} or {last}")
        self.require_at_least(1, "batch")
        if self.learns_from_runs and self.simulations < self.batch:
            raise InputError(
                f"training: {self.simulations} simulations are fewer than a batch of {self.batch}"
            )

    @property
    def learns_from_runs(self) -> bool:
        """Whether FEM runs are in the objective."""
        return self.objective != "energy"


@dataclass(frozen=True)
class GraphNetwork(BatchPlan):
    """A graph network about the FEM solution at the centre, or from zero.

    centred : whether the network is added to the FEM solution at the centre, or to zero.
    schedule : ``cosine`` to zero after a warm-up, or ``halves``: the rate, then a tenth of it.
    decoder : ``pointwise``, or ``separable`` without mechanical modes.
    """

    recipe: str = "network"
    centred: bool = True
    schedule: Literal["cosine", "halves"] = "cosine"
    decoder: Literal["pointwise", "separable"] = "pointwise"

    @property
    def runs(self) -> int:
        """The number of FEM runs besides the one at the centre, which the energy alone needs."""
        return self.simulations if self.learns_from_runs else 0

    @property
    def rate(self) -> Rate:
        """The learning rate as a function of the step."""
        return (halves if self.schedule == "halves" else cosine)(self.learning_rate)

    def prepare(self, job: Job) -> Problem:
        """Return the FEM runs, and an emulator whose network is untrained."""
        scene, architecture = job.scene, architecture_of(self, job, self.decoder)
        runs = job.fem_runs(Simulator(scene), self)
        job.require_time(f"{len(runs.theta)} FEM runs")
        plan = self.with_counts(simulations=len(runs.theta) - 1) if self.runs else self
        if self.centred:
            series = constant(np.asarray(scene.to_unit(scene.centre)), runs.displacement[0])
            scale = component_scales(scene, runs, from_runs=self.learns_from_runs)
        else:
            series = None
            scale = np.full(3, np.sqrt(np.mean(np.asarray(runs.displacement[0]) ** 2)))
        emulator = untrained(plan, job, series, architecture, scale)
        training = batch_training(emulator, plan, self.rate, runs)
        return Problem(plan, emulator, runs, training)


PAPER = GraphNetwork(
    recipe="paper",
    objective="energy",
    centred=False,
    batch=1,
    learning_rate=1e-4,
    schedule="halves",
    steps=100_000,
)
"""The recipe of the paper."""


def batch_training(
    emulator: Emulator, plan: BatchPlan, rate: Rate, runs: Runs, freeze: int | None = None
) -> NetworkTraining:
    """Return the training of the emulator's network on batches of theta, by Adam.

    freeze : the step at which the modes of a separable decoder are frozen; ``None`` for never.
    """
    scene, network = emulator.scene, emulator.network
    assert network is not None, "an emulator in training has a network"
    predict = predictor(emulator)
    scales = loss_scales(scene, runs, from_runs=plan.learns_from_runs)
    loss = make_loss(scene, plan.objective, scales)

    def draw(number: jax.Array) -> Runs:
        """Return the batch of a step, which follows from its number."""
        key = jax.random.fold_in(jax.random.key(plan.seed), number)
        if not plan.learns_from_runs:
            return Runs(uniform(scene, plan.batch, key), jnp.zeros(0), jnp.zeros(0))
        rows = jax.random.choice(key, len(runs.theta), (plan.batch,), replace=False)
        return runs._replace(sensitivities=None).take(rows)

    def descend(
        weights: Weights, number: jax.Array, *frozen: jax.Array
    ) -> tuple[jax.Array, Weights, Weights]:
        batch = draw(number)
        misfit = lambda w: loss(predict(w, batch.theta, *frozen), batch)  # noqa: E731
        return *jax.value_and_grad(misfit)(weights), weights

    def frozen(weights: Weights) -> tuple[jax.Array, ...]:
        return (jax.jit(lambda w: network.prepare(w)[1])(weights),)

    return NetworkTraining(network, clipped_adam(), rate, descend, freeze, frozen)


def predictor(emulator: Emulator) -> Callable[..., jax.Array]:
    """Return ``predict(weights, thetas, *frozen)``: displacement (b, n, 3) mm at theta (b, p).

    It is the emulator's with other weights of its network. ``frozen`` is the part of the decoder
    that does not depend on theta; without it the processor is run.
    """
    scene, network, series = emulator.scene, emulator.network, emulator.taylor
    assert network is not None, "an emulator in training has a network"

    def predict(weights: Weights, thetas: jax.Array, *frozen: jax.Array) -> jax.Array:
        position = scene.to_unit(thetas)
        if frozen:
            decoder = nnx.merge(network.definition, weights).decoder
            free = network.decode(decoder, frozen[0], position)
        else:
            free = network.predict(weights, position)
        return scene.on_supports(free if series is None else series(position) + free, thetas)

    return predict
