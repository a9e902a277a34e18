"""Recipes ``modal`` and ``physics``: a network alone, its modes first, then their coefficients.

The network is added to the equilibrium at the centre of the box and learns values and slopes in
theta (:mod:`~emulator.training.mode_fit`): those of FEM runs (``modal``), or those of a polynomial
that sweeps over the box have fitted to the energy, without any FEM run (``physics``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

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
from emulator.training.mode_fit import ModeFit
from emulator.training.network_plan import NetworkPlan, Problem, architecture_of, untrained
from emulator.training.objectives import loss_scales
from emulator.training.optimiser import NetworkTraining, orthogonal_steps, two_cosines
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
class Modal(NetworkPlan):
    """A separable network that is fitted to values and slopes of FEM runs.

    simulations : the number of runs that the network is fitted to.
    freeze : the step at which the modes are frozen; half of the steps where it is not below them.
    polish : the number of iterations of L-BFGS on the branch after the steps.
    """

    recipe: str = "modal"
    steps: int = 20_000
    learning_rate: float = 2e-3
    simulations: int = 400
    freeze: int = 2000
    polish: int = 4000
    needs_slopes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_runs(self.simulations, "modes need")

    @property
    def budget_share(self) -> float:
        """The share of a budget after which the last step ends and the polish begins."""
        return 0.85 if self.polish else 0.99

    def prepare(self, job: Job) -> Problem:
        """Return the FEM runs, and an emulator whose network is untrained."""
        architecture = architecture_of(self, job, "separable", ARCHITECTURE)
        runs = job.fem_runs(Simulator(job.scene), self)
        job.require_time(f"{len(runs.theta)} FEM runs")
        return self.with_counts(simulations=len(runs.theta) - 1).fitted_to(runs, job, architecture)

    def fitted_to(self, runs: Runs, job: Job, architecture: Architecture) -> Problem:
        """Return an emulator whose network is untrained, to fit to ``runs``."""
        scene = job.scene
        plan = self if self.freeze < self.steps else replace(self, freeze=self.steps // 2)
        series = constant(np.asarray(scene.to_unit(scene.centre)), runs.displacement[0])
        scales = loss_scales(scene, runs, from_runs=True)
        scale = np.full(3, scales.displacement)  # products of modes are the same in all directions
        emulator = untrained(plan, job, series, architecture, scale)
        assert emulator.network is not None, "it was made above"
        fit = ModeFit(scene, emulator.network, runs, scales)
        training = NetworkTraining(
            fit.network,
            orthogonal_steps(),
            two_cosines(plan.learning_rate, plan.freeze),
            fit.descend,
            plan.freeze,
            fit.branch_targets,
            partial(fit.finish, plan.polish),
        )
        return Problem(plan, emulator, runs, training)


@dataclass(frozen=True)
class Physics(Modal):
    """A separable network that is fitted to values and slopes of a polynomial of sweeps.

    simulations : the number of theta at which the network is fitted to the polynomial.
    sweeps : the largest number of sweeps over the box.
    """

    recipe: str = "physics"
    sweeps: int = 60

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(1, "sweeps")

    @property
    def runs(self) -> int:
        """The number of FEM runs: none, not even the one at the centre of the box."""
        return 0

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the trained emulator and its record."""
        check_sweeps(job.scene, self.sweeps, at_rest=True)
        if session.arrays is None:
            session.write_plan(self)
        return super().train(job, session)

    def prepare(self, job: Job) -> Problem:
        """Return what the sweeps give, and an emulator whose network is untrained."""
        scene, simulator = job.scene, Simulator(job.scene)
        architecture = architecture_of(self, job, "separable", ARCHITECTURE)
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
        problem = self.with_counts(sweeps=state.number).fitted_to(runs, job, architecture)
        return replace(problem, record={"sweeps": state.record})
