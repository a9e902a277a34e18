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

from emulator.fem import Simulator
from emulator.fem.campaign.designs import uniform
from emulator.fem.energy import potential_energy
from emulator.mechanics.kinematics import Barriers
from emulator.surrogates.network.pignn import Architecture
from emulator.training.network_plan import NetworkPlan, PreparedTraining, untrained
from emulator.training.optimiser import NetworkTraining, Weights, clipped_adam, halves
from emulator.training.plan import Job


@dataclass(frozen=True)
class Paper(NetworkPlan):
    """A graph network with a pointwise decoder, trained from zero on the energy alone.

    batch : the number of theta a step.
    """

    recipe: str = "paper"
    steps: int = 100_000
    learning_rate: float = 1e-4
    batch: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(1, "batch")

    def prepare(self, job: Job) -> PreparedTraining:
        """Return the FEM solution at the centre, and an emulator whose network is untrained."""
        scene = job.scene
        architecture = replace(job.architecture or Architecture(), decoder="pointwise")
        runs = job.fem_runs(Simulator(scene), self)
        job.require_time("the FEM run at the centre of the box")
        scale = np.full(3, np.sqrt(np.mean(np.asarray(runs.displacement[0]) ** 2)))
        emulator = untrained(self, scene, None, architecture, scale)
        network = emulator.network
        assert network is not None, "an emulator in training has a network"
        energy = jax.vmap(potential_energy(scene, Barriers()))
        unit = abs(float(runs.energy[0]))

        def descend(weights: Weights, number: jax.Array) -> tuple[jax.Array, Weights, Weights]:
            """Return the loss at the theta of a step, which follow from its number."""
            key = jax.random.fold_in(jax.random.key(self.seed), number)
            thetas = uniform(scene, self.batch, key)

            def loss(weights: Weights) -> jax.Array:
                free = network.predict(weights, scene.to_unit(thetas))
                return jnp.mean(energy(scene.on_supports(free, thetas), thetas)) / unit

            return *jax.value_and_grad(loss)(weights), weights

        training = NetworkTraining(network, clipped_adam(), halves(self.learning_rate), descend)
        return PreparedTraining(self, emulator, runs, training)
