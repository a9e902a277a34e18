"""Recipe ``physics``: a network alone, its modes first, then their coefficients.

The network is added to the equilibrium at the centre of the box and learns values and slopes in
theta (:mod:`~emulator.training.mode_fit`): those of a polynomial that sweeps over the box have
fitted to the energy, so that no FEM run is made; or, with zero sweeps, those of FEM runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from emulator.fem.campaign import Runs
from emulator.fem.campaign.designs import design
from emulator.fem.energy import require_rest
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network import fresh
from emulator.surrogates.network.graph import augment
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import constant
from emulator.training.job import FEM_SHARE, Job, Recipe
from emulator.training.mode_fit import ModeFit, scales_of
from emulator.training.optimiser import (
    NetworkTraining,
    PreparedTraining,
    cosine,
    orthogonal_steps,
    train_network,
)
from emulator.training.plan import Plan, check_rate, check_runs
from emulator.training.sweeps import check_sweeps, runs_of, sweep_box

ARCHITECTURE = Architecture(
    steps=3,
    latent=24,
    hidden=(64, 64),
    decoder="separable",
    modes=40,
    trunk=(64, 512),
    branch=(128, 128, 128),
    branch_activation="swish",
)
"""Smaller messages than the paper's, a wide last layer of the trunk, which costs a least-squares
solve, and a deep branch (docs/experiments.md, "A network alone")."""
# Shares of a budget after which the last step ends, and the branch's fit.
_STEPS_SHARE, _POLISH_SHARE = 0.8, 0.97


@dataclass(frozen=True)
class PhysicsPlan(Plan):
    """A separable network that is fitted to values and slopes of equilibria.

    steps, learning_rate : the number of optimiser steps, and the largest learning rate.
    sweeps : the largest number of sweeps over the box; 0 for FEM runs instead.
    simulations : the number of theta at which equilibria are taken from sweeps or from FEM.
    polish : the largest number of iterations of L-BFGS on the branch, after the modes' steps.
    """

    recipe: str = "physics"
    steps: int = 2000
    learning_rate: float = 2e-3
    sweeps: int = 60
    simulations: int = 400
    polish: int = 600

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(1, "steps")
        self.require_at_least(0, "sweeps")
        check_rate(self.learning_rate)
        check_runs(self.simulations, "modes need")


def train_physics(plan: PhysicsPlan, job: Job) -> Emulator:
    """Return the trained emulator and its record."""
    return train_network(prepare(plan, job), job, _STEPS_SHARE if plan.polish else _POLISH_SHARE)


def prepare(plan: PhysicsPlan, job: Job) -> PreparedTraining:
    """Return the equilibria to learn from, and an emulator whose network is untrained."""
    scene = job.scene
    require_rest(scene)  # networks learn from the energy there
    if plan.sweeps:
        check_sweeps(scene, plan.sweeps, at_rest=True)
        plan, runs, record = _swept(plan, job)
    else:
        runs, record = job.fem_runs(plan), {}
        job.require_time(f"{len(runs.theta)} FEM runs")
        plan = replace(plan, simulations=len(runs.theta) - 1)
    architecture = replace(job.architecture or ARCHITECTURE, decoder="separable")
    series = constant(np.asarray(scene.to_unit(scene.centre)), runs.displacement[0])
    scales = scales_of(scene, runs)
    scale = np.full(3, scales.displacement)  # products of modes are the same in all directions
    network = fresh(scene, augment(scene), architecture, scale, plan.seed)
    fit = ModeFit(scene, network, runs, scales)
    training = NetworkTraining(
        network,
        orthogonal_steps(),
        cosine(plan.learning_rate),
        fit.descend,
        lambda loss: f"misfit of modes and gradients {abs(loss) ** 0.5:.1e} of their size",
        partial(fit.finish, plan.polish, job.deadline(_POLISH_SHARE)),
    )
    emulator = Emulator(scene, taylor=series, network=network)
    return PreparedTraining(plan, emulator, runs, training, record)


def _swept(plan: PhysicsPlan, job: Job) -> tuple[PhysicsPlan, Runs, dict[str, Any]]:
    """Return the plan with the sweeps made, their polynomial at ``simulations`` theta."""
    state = sweep_box(
        job.simulator,
        plan.sweeps,
        plan.seed,
        checkpoint=job.checkpoint("sweeps"),
        deadline=job.deadline(FEM_SHARE),
        require_time=job.require_time,
        progress=job.progress,
    )
    thetas = design(job.scene, plan.simulations, plan.seed)
    runs = runs_of(job.simulator, state, jnp.concatenate([job.scene.centre[None], thetas]))
    job.require_time(f"{state.number} sweeps")
    return replace(plan, sweeps=state.number), runs, {"sweeps": state.record}


PHYSICS = Recipe(PhysicsPlan(), train_physics)
