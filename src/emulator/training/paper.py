r"""Recipe ``paper``: the graph network of Dalton et al. (2023), Algorithm 1, trained as they did.

A step lowers the mean potential energy at a few theta drawn anew,

.. math:: \tfrac1b \sum \Pi(u, \theta) / |\Pi_c| ,

with :math:`\Pi_c` the energy of the FEM solution at the centre of the box, whose root mean square
also scales the network's displacement; nothing else is solved. The energies pass through the
barriers, which are inactive near any solution. Adam's rate is 1e-4, and a tenth of it in the second
half of the steps, as in the released code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.campaign.designs import uniform
from emulator.fem.energy import potential_energy, require_rest
from emulator.mechanics.kinematics import Barriers
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network import fresh
from emulator.surrogates.network.graph import augment
from emulator.surrogates.network.pignn import Architecture
from emulator.training.job import Job, Recipe
from emulator.training.optimiser import (
    NetworkTraining,
    PreparedTraining,
    Weights,
    clipped_adam,
    halves,
    train_network,
)
from emulator.training.plan import Plan, check_rate


@dataclass(frozen=True)
class Paper(Plan):
    """A graph network with a pointwise decoder, trained from zero on the energy alone.

    steps, learning_rate : the number of optimiser steps, and the largest learning rate.
    batch : the number of theta a step.
    """

    recipe: str = "paper"
    steps: int = 100_000
    learning_rate: float = 1e-4
    batch: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(1, "steps", "batch")
        check_rate(self.learning_rate)


def train_paper(plan: Paper, job: Job) -> Emulator:
    """Return the trained emulator and its record."""
    return train_network(prepare(plan, job), job, 0.97)


def prepare(plan: Paper, job: Job) -> PreparedTraining:
    """Return the FEM solution at the centre, and an emulator whose network is untrained."""
    scene = job.scene
    require_rest(scene)  # networks learn from the energy there
    architecture = replace(job.architecture or Architecture(), decoder="pointwise")
    runs = job.fem_runs(plan)
    job.require_time("the FEM run at the centre of the box")
    scale = np.full(3, np.sqrt(np.mean(np.asarray(runs.displacement[0]) ** 2)))
    network = fresh(scene, augment(scene), architecture, scale, plan.seed)
    energy = jax.vmap(potential_energy(scene, Barriers()))
    unit = abs(float(runs.energy[0]))

    def descend(weights: Weights, number: jax.Array) -> tuple[jax.Array, Weights, Weights]:
        """Return the loss at the theta of a step, which follow from its number."""
        key = jax.random.fold_in(jax.random.key(plan.seed), number)
        thetas = uniform(scene, plan.batch, key)

        def loss(weights: Weights) -> jax.Array:
            free = network.predict(weights, scene.to_unit(thetas))
            return jnp.mean(energy(scene.on_supports(free, thetas), thetas)) / unit

        return *jax.value_and_grad(loss)(weights), weights

    training = NetworkTraining(
        network,
        clipped_adam(),
        halves(plan.learning_rate),
        descend,
        "potential energy {:.4f} of the centre's".format,
    )
    return PreparedTraining(plan, Emulator(scene, network=network), runs, training)


PAPER = Recipe(Paper(), train_paper)
