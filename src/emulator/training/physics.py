"""Recipe ``physics``: a network alone, its modes first, then their coefficients.

The network is added to the equilibrium at the centre of the box and learns values and slopes in
theta (:mod:`~emulator.training.mode_fit`): those of a polynomial that sweeps over the box have
fitted to the energy, so that no FEM run is made; or, with zero sweeps, those of FEM runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.fem.campaign import Runs
from emulator.fem.campaign.designs import design
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import constant
from emulator.training.checkpoint import Record, Session
from emulator.training.mechanics import FEM_SHARE
from emulator.training.mode_fit import ModeFit, scales_of
from emulator.training.network_plan import NetworkPlan, PreparedTraining, untrained
from emulator.training.optimiser import NetworkTraining, cosine, orthogonal_steps
from emulator.training.plan import Job, check_runs
from emulator.training.sweeps import check_sweeps, runs_of, sweep_box

ARCHITECTURE = Architecture(
    steps=3,
    latent=24,
    hidden=(64, 64),
    decoder="separable",
    modes=40,
    trunk=(64, 512),
    branch=(128, 128, 128),
)
"""Smaller messages than the paper's, a wide last layer of the trunk, which costs a least-squares
solve, and a deep branch (docs/experiments.md, "A network alone")."""


@dataclass(frozen=True)
class PhysicsPlan(NetworkPlan):
    """A separable network that is fitted to values and slopes of equilibria.

    sweeps : the largest number of sweeps over the box; 0 for FEM runs instead.
    simulations : the number of theta at which equilibria are taken from sweeps or from FEM.
    polish : the largest number of iterations of L-BFGS on the branch, after the modes' steps.
    """

    recipe: str = "physics"
    steps: int = 2000
    learning_rate: float = 2e-3
    sweeps: int = 60
    simulations: int = 400
    polish: int = 3000

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(0, "sweeps")
        check_runs(self.simulations, "modes need")

    @property
    def budget_share(self) -> float:
        """The share of a budget after which the last step ends and the polish begins."""
        return 0.85 if self.polish else 0.99

    @property
    def runs(self) -> int:
        """The number of FEM runs: with sweeps none, not even the one at the centre of the box."""
        return 0 if self.sweeps else self.simulations

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the trained emulator and its record."""
        if self.sweeps:
            check_sweeps(job.scene, self.sweeps, at_rest=True)
            if session.arrays is None:
                session.write_plan(self)
        return super().train(job, session)

    def prepare(self, job: Job) -> PreparedTraining:
        """Return the equilibria to learn from, and an emulator whose network is untrained."""
        if self.sweeps:
            plan, runs, record = self._swept(job)
        else:
            runs, record = job.fem_runs(Simulator(job.scene), self), {}
            job.require_time(f"{len(runs.theta)} FEM runs")
            plan = self.with_counts(simulations=len(runs.theta) - 1)
        scene = job.scene
        architecture = replace(job.architecture or ARCHITECTURE, decoder="separable")
        series = constant(np.asarray(scene.to_unit(scene.centre)), runs.displacement[0])
        scales = scales_of(scene, runs)
        scale = np.full(3, scales.displacement)  # products of modes are the same in all directions
        emulator = untrained(plan, scene, series, architecture, scale)
        assert emulator.network is not None, "it was made above"
        fit = ModeFit(scene, emulator.network, runs, scales)
        training = NetworkTraining(
            fit.network,
            orthogonal_steps(),
            cosine(plan.learning_rate),
            fit.descend,
            partial(fit.finish, plan.polish, job.deadline(0.99)),
        )
        return PreparedTraining(plan, emulator, runs, training, record)

    def _swept(self, job: Job) -> tuple[Self, Runs, Record]:
        """Return the plan with the sweeps made, their polynomial at ``simulations`` theta."""
        scene, simulator = job.scene, Simulator(job.scene)
        state = sweep_box(
            simulator,
            self.sweeps,
            self.seed,
            folder=job.folder,
            deadline=job.deadline(FEM_SHARE),
            progress=job.progress,
        )
        thetas = design(scene, self.simulations, self.seed)
        runs = runs_of(simulator, state, jnp.concatenate([scene.centre[None], thetas]))
        job.require_time(f"{state.number} sweeps")
        return self.with_counts(sweeps=state.number), runs, {"sweeps": state.record}
