"""An untrained network and one optimiser step of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from emulator.fem import Simulator
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.network.graph import augment
from emulator.surrogates.network.part import Network, fresh
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import Expansion
from emulator.training.basis import mechanical_modes
from emulator.training.modal import ARCHITECTURE, Modal
from emulator.training.objectives import Scales, make_loss, mean_square_gradient
from emulator.training.plan import Plan
from emulator.training.step import Step, batch_descent, clipped_adam, make_step, orthogonal_steps

# Standard deviation of the displacements as a fraction of the centre's, where no FEM run tells it.
_GUESSED_SD = 0.2


@dataclass(frozen=True, eq=False)
class NetworkTraining:
    """How a network is trained.

    network : untrained.
    optimiser, step : see :func:`~emulator.training.step.make_step`.
    modal : what teaches the network modes and then coefficients, for plans that do.
    """

    plan: Plan
    network: Network
    optimiser: optax.GradientTransformation
    step: Step
    modal: Modal | None = None

    def initial(self) -> tuple[Any, Any]:
        """Copies of the untrained weights, and the optimiser's state."""
        weights = jax.tree.map(jnp.copy, self.network.weights)
        return weights, self.optimiser.init(weights)

    def keep(self, weights: Any) -> tuple[jax.Array, ...]:
        """What steps after ``plan.freeze`` of a separable decoder take from ``weights``."""
        if self.modal is not None:
            return tuple(self.modal.keep(weights))
        return (jax.jit(lambda w: self.network.prepare(w)[1])(weights),)

    def finish(self, weights: Any, *, progress: bool = False) -> Any:
        """The trained weights, from those after the last step."""
        if self.modal is None:
            return weights
        return self.modal.finish(weights, self.plan.polish, progress=progress)


def network_training(emulator: Emulator, plan: Plan, runs: Runs, scales: Scales) -> NetworkTraining:
    """The training of the network in ``emulator``; ``scales`` are those of the loss."""
    scene, network = emulator.scene, emulator.network
    assert network is not None, "asked only of an emulator with a network"
    if plan.objective == "modes":
        modal, optimiser = Modal(scene, network, runs, scales), orthogonal_steps()
        return NetworkTraining(
            plan, network, optimiser, make_step(plan, modal.descend, optimiser), modal
        )
    optimiser, loss = clipped_adam(), make_loss(scene, plan.objective, scales, plan.energy_weight)
    step = make_step(plan, batch_descent(emulator, plan, runs, loss), optimiser)
    return NetworkTraining(plan, network, optimiser, step)


def untrained(
    simulator: Simulator,
    plan: Plan,
    architecture: Architecture | None,
    series: Expansion | None,
    scale: np.ndarray,
) -> Network:
    """An untrained network; a separable decoder is given the mechanical modes of the series."""
    usual = ARCHITECTURE if plan.objective == "modes" else Architecture()
    architecture = replace(architecture or usual, decoder=plan.decoder)
    basis = None
    if plan.decoder == "separable" and series is not None:
        basis = (mechanical_modes(simulator, series, plan.modes) / scale).astype(np.float32)
    scene = simulator.scene
    return fresh(scene, augment(scene), architecture, scale, plan.seed, basis)


def scales_of(scene: Scene, plan: Plan, runs: Runs) -> tuple[np.ndarray, Scales]:
    """Scales of the network's output by component, (3,) mm, and of the loss.

    Root mean squares of the runs' deviations from the centre's solution.
    """
    centre = np.asarray(runs.displacement[0])
    known = len(runs.theta) > 1 and plan.objective != "energy"
    deviation = np.asarray(runs.displacement[1:]) - centre if known else _GUESSED_SD * centre[None]
    free = ~scene.held
    component = [float(np.sqrt(np.mean(deviation[:, free[:, k], k] ** 2))) for k in range(3)]
    scales = Scales(
        displacement=float(np.sqrt(np.mean(np.sum(deviation**2, axis=-1)))),
        gradient=float(jnp.sqrt(mean_square_gradient(scene, jnp.asarray(deviation)))),
        energy=float(jnp.abs(runs.energy[0])),
    )
    if plan.objective == "modes":  # their products are the same in all directions
        return np.full(3, scales.displacement), scales
    if not plan.centred:
        return np.full(3, np.sqrt(np.mean(centre**2))), scales
    return np.maximum(component, 1e-3 * max(component)), scales
