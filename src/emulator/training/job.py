"""What a recipe is, and what it is given: scene, start, FEM runs of a campaign, and time."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Predictor, Runs, StoredRuns, run_campaign
from emulator.fem.campaign.designs import design, sobol
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import Session
from emulator.training.plan import Plan, Record

FEWEST = 10
"""The least number of FEM runs of which some are held out to judge a discrepancy model."""
LEAST_S = 5.0
"""The seconds below which a budget is refused at once."""


@dataclass(frozen=True)
class Budget:
    """The seconds that a training may take, from ``started`` of the performance counter on.

    Raises
    ------
    InputError
        Fewer than 5 seconds, in which nothing can be compiled and solved.
    """

    seconds: float
    started: float

    def __post_init__(self) -> None:
        if self.seconds < LEAST_S:
            raise InputError(
                f"a budget of {self.seconds:g} s: one FEM solution and its compilation alone take "
                f"more than {LEAST_S:g} s; give a minute or more"
            )

    def require(self, stage: str) -> None:
        """Raise :class:`InputError` where the time is over when only ``stage`` is done."""
        spent = time.perf_counter() - self.started
        if spent > self.seconds:
            raise InputError(
                f"the budget of {self.seconds:g} s is over after {stage}, {spent:.0f} s; give "
                f"{4.0 * spent:.0f} s or more"
            )

    def until(self, share: float) -> float:
        """Return the time at which this ``share`` of the budget is spent."""
        return self.started + share * self.seconds


@dataclass(frozen=True, eq=False)
class Job:
    """One training.

    Parameters
    ----------
    scene : the scene to emulate.
    architecture : the sizes of the network; ``None`` for the recipe's sizes.
    start : the emulator to begin from, or ``None``.
    campaign : the stored FEM runs to use; only the one at the centre is then solved.
    folder : the folder of the sweeps' checkpoint, from which they resume; ``None`` for none.
    budget : the time for everything; ``None`` for as long as it takes.
    progress : whether progress bars are shown.
    """

    scene: Scene
    architecture: Architecture | None = None
    start: Emulator | None = None
    campaign: StoredRuns | None = None
    folder: Path | None = None
    budget: Budget | None = None
    progress: bool = False

    def deadline(self, share: float) -> float:
        """Return the time at which this share of the budget is spent; infinite without a budget."""
        return np.inf if self.budget is None else self.budget.until(share)

    def require_time(self, stage: str) -> None:
        """Raise :class:`InputError` where the budget is over when only ``stage`` is done."""
        if self.budget is not None:
            self.budget.require(stage)

    def fem_runs(
        self,
        simulator: Simulator,
        plan: Plan,
        predictor: Predictor | None = None,
        deadline: float = np.inf,
    ) -> Runs:
        """Return the FEM solutions of ``plan``, the one at the centre first.

        Parameters
        ----------
        predictor : the function that predicts the start of Newton's method.
        deadline : the time after which no further run begins, except the fewest by which a
            discrepancy model can be judged.
        """
        thetas = self.scene.centre[None]
        campaign_runs = None if self.campaign is None else _first_runs(self.campaign, plan)
        if campaign_runs is None and plan.runs:
            draw = design if plan.needs_slopes else sobol
            thetas = jnp.concatenate([thetas, draw(self.scene, plan.runs, plan.seed)])
        runs = run_campaign(
            simulator,
            thetas,
            sensitivities=plan.needs_slopes,
            predictor=predictor,
            deadline=deadline,
            at_least=FEWEST + 1,
            progress=self.progress,
        )
        return runs if campaign_runs is None else runs.followed_by(campaign_runs)


def _first_runs(campaign: StoredRuns, plan: Plan) -> Runs:
    """Return the runs of a campaign that ``plan`` needs."""
    available = len(campaign.runs.theta)
    if plan.runs > available:
        raise InputError(
            f"training: {plan.runs} simulations of a campaign with {available} that converged"
        )
    if plan.needs_slopes and campaign.runs.sensitivities is None:
        raise InputError(
            f"training: recipe '{plan.recipe}' needs slopes, which the campaign lacks; make one "
            "with --slopes"
        )
    return campaign.runs.take(slice(plan.runs))


class Recipe(Plan, ABC):
    """The options of a recipe, and the method that trains an emulator by it."""

    def default_start(
        self, scene: Scene, folder: Path, *, resume: bool, progress: bool
    ) -> Emulator | None:
        """Return the emulator to begin from where none is given; ``folder`` may keep it."""
        del scene, folder, resume, progress
        return None

    @abstractmethod
    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the trained emulator and its record; ``session`` writes checkpoints."""
