"""The options that all recipes have, and the inputs of a training.

A recipe is a frozen dataclass of its options with a method that trains an emulator, in a file of
its own; all of them are listed in :mod:`emulator.training.trainer`.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, check_seed
from emulator.fem import Simulator
from emulator.fem.campaign import Predictor, Runs, StoredRuns, run_campaign
from emulator.fem.campaign.designs import design
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import Record, Session

FEWEST = 10
"""The least number of FEM runs of which some are held out to judge a discrepancy model."""
LEAST_S = 5.0
"""The seconds below which a budget is refused at once."""


@dataclass(frozen=True)
class Plan:
    """The options that all recipes have.

    Parameters
    ----------
    recipe : the name of the recipe in :data:`~emulator.training.trainer.RECIPES`.
    seed : the seed from which the weights, the theta of the FEM runs and the batches are drawn.
    campaign : the digest of the campaign whose first rows are the FEM runs; empty where training
        makes them.
    """

    recipe: str = ""
    seed: int = 0
    campaign: str = ""

    def __post_init__(self) -> None:
        check_seed(self.seed, "training")

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the trained emulator and its record; ``session`` writes checkpoints."""
        raise NotImplementedError

    def default_start(self, job: Job, *, resume: bool) -> Emulator | None:  # noqa: ARG002
        """Return the emulator to begin from where none is given; the job's folder may keep it."""
        return None

    @property
    def runs(self) -> int:
        """The number of FEM runs besides the one at the centre of the box."""
        return getattr(self, "simulations", 0)

    @property
    def trains_network(self) -> bool:
        """Whether there are optimiser steps, whose number a time budget may set."""
        return hasattr(self, "steps")

    def with_counts(self, **counts: int) -> Self:
        """Return the plan with the numbers of ``simulations``, ``steps`` or ``sweeps`` done.

        Counts that the recipe does not have are left out.
        """
        names = {option.name for option in fields(self)}
        own_counts: dict[str, Any] = {name: n for name, n in counts.items() if name in names}
        return replace(self, **own_counts)

    def record(self, loss: float | None = None) -> Record:
        """Return the entries that every emulator's record has."""
        return {"plan": asdict(self), "final_loss": loss}

    def require_at_least(self, least: int, *names: str) -> None:
        """Raise :class:`InputError` for an option in ``names`` that is below ``least``."""
        for name in names:
            if getattr(self, name) < least:
                raise InputError(
                    f"training: {name} is {getattr(self, name)}; it must be {least} or more"
                )


def check_runs(simulations: int, needed_by: str = "a discrepancy model needs") -> None:
    """Raise :class:`InputError` where no FEM run is to be made besides the centre's."""
    if simulations < 1:
        raise InputError(f"training: {simulations} simulations; {needed_by} 1 or more")


def check_order(order: int) -> None:
    """Raise :class:`InputError` unless ``order`` is an order of a Taylor series."""
    if not 0 <= order <= 4:
        raise InputError(f"training: a series of order {order}; give 0 to 4")


@dataclass(frozen=True, eq=False)
class Job:
    """One training.

    scene : the scene to emulate.
    architecture : the sizes of the network; ``None`` for the recipe's sizes.
    start : the emulator to begin from, or ``None``.
    campaign : the stored FEM runs to use; only the one at the centre is then solved.
    folder : the folder of the sweeps' checkpoint, from which they resume; ``None`` for none.
    budget : the seconds for everything, from ``began`` of the performance counter on.
    progress : whether progress bars are shown.

    Raises :class:`InputError`: a budget of fewer than 5 seconds, in which nothing can be compiled
    and solved.
    """

    scene: Scene
    architecture: Architecture | None = None
    start: Emulator | None = None
    campaign: StoredRuns | None = None
    folder: Path | None = None
    budget: float = np.inf
    began: float = 0.0
    progress: bool = False

    def __post_init__(self) -> None:
        if self.budget < LEAST_S:
            raise InputError(
                f"a budget of {self.budget:g} s: one FEM solution and its compilation alone take "
                f"more than {LEAST_S:g} s; give a minute or more"
            )

    def deadline(self, share: float) -> float:
        """Return the time at which this share of the budget is spent; infinite without a budget."""
        return self.began + share * self.budget

    def require_time(self, stage: str) -> None:
        """Raise :class:`InputError` where the budget is over when only ``stage`` is done."""
        spent = time.perf_counter() - self.began
        if spent > self.budget:
            raise InputError(
                f"the budget of {self.budget:g} s is over after {stage}, {spent:.0f} s; give "
                f"{4.0 * spent:.0f} s or more"
            )

    def fem_runs(
        self,
        simulator: Simulator,
        plan: Plan,
        predictor: Predictor | None = None,
        deadline: float = np.inf,
    ) -> Runs:
        """Return the FEM solutions of ``plan``, the one at the centre first.

        predictor : the function that predicts the start of Newton's method.
        deadline : the time after which no further run begins, except the fewest by which a
            discrepancy model can be judged.
        """
        thetas = self.scene.centre[None]
        stored = None if self.campaign is None else _first_runs(self.campaign.runs, plan)
        if stored is None and plan.runs:
            thetas = jnp.concatenate([thetas, design(self.scene, plan.runs, plan.seed)])
        runs = run_campaign(
            simulator,
            thetas,
            sensitivities=plan.runs > 0,
            predictor=predictor,
            deadline=deadline,
            at_least=FEWEST + 1,
            progress=self.progress,
        )
        if stored is None:
            return runs
        return jax.tree.map(lambda *both: jnp.concatenate(both), runs, stored)


def _first_runs(stored: Runs, plan: Plan) -> Runs:
    """Return the runs of a campaign that ``plan`` needs, with their slopes."""
    if plan.runs > len(stored.theta):
        raise InputError(
            f"training: {plan.runs} simulations of a campaign with {len(stored.theta)} that "
            "converged"
        )
    if stored.sensitivities is None:
        raise InputError(
            f"training: recipe '{plan.recipe}' needs slopes, which the campaign lacks; make one "
            "with --slopes"
        )
    return stored.take(slice(plan.runs))
