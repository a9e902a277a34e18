"""One training: its recipe, its inputs, its clock, and the folder from which it is resumed.

A recipe is a frozen dataclass of its options and a function that trains by them, in a file of its
own; all of them are listed in :mod:`emulator.training.trainer`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError
from emulator.core.store import write_json
from emulator.fem import Simulator
from emulator.fem.campaign import Predictor, Runs, StoredRuns, run_campaign
from emulator.fem.campaign.designs import design
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.plan import Plan

DESCRIPTION = "training.json"
"""The file beside the checkpoints that says whose they are, and how long it took so far."""
FEWEST = 10
"""The least number of FEM runs of which some are held out to judge a discrepancy model."""
FEM_SHARE = 0.3
"""The share of a budget after which no FEM run and no sweep begins."""
LEAST_S = 5.0
"""The seconds below which a budget is refused at once."""
_EVERY = 20.0  # seconds between two checkpoints


@dataclass(frozen=True, eq=False)
class Job:
    """One training.

    scene : the scene to emulate.
    architecture : the sizes of the network; ``None`` for the recipe's sizes.
    start : the emulator to begin from, or ``None``.
    campaign : the stored FEM runs to use; only the one at the centre is then solved.
    folder : the folder of the checkpoints; ``None`` for none.
    identity : what the checkpoints depend on, as JSON: scene, plan, sizes and start.
    budget : the seconds for everything, from ``began`` of the performance counter on.
    progress : whether progress is shown.

    Raises :class:`InputError`: a budget of fewer than 5 seconds, in which nothing can be compiled
    and solved.
    """

    scene: Scene
    architecture: Architecture | None = None
    start: Emulator | None = None
    campaign: StoredRuns | None = None
    folder: Path | None = None
    identity: Mapping[str, Any] = field(default_factory=dict)
    budget: float = np.inf
    began: float = field(default_factory=time.perf_counter)
    progress: bool = False

    def __post_init__(self) -> None:
        if self.budget < LEAST_S:
            raise InputError(
                f"a budget of {self.budget:g} s: one FEM solution and its compilation alone take "
                f"more than {LEAST_S:g} s; give a minute or more"
            )

    @cached_property
    def simulator(self) -> Simulator:
        """The simulator of the scene."""
        return Simulator(self.scene)

    @property
    def seconds(self) -> float:
        """The time spent so far, also before a kill."""
        return time.perf_counter() - self.began

    def deadline(self, share: float) -> float:
        """Return the time at which this share of the budget is spent; infinite without a budget."""
        return self.began + share * self.budget

    def require_time(self, stage: str) -> None:
        """Raise :class:`InputError` where the budget is over when only ``stage`` is done."""
        if self.seconds > self.budget:
            if self.folder is not None:
                self.describe()
            raise InputError(
                f"the budget of {self.budget:g} s is over after {stage}, {self.seconds:.0f} s; "
                f"give {4.0 * self.seconds:.0f} s or more, or go on with --resume --budget TIME"
            )

    def checkpoint(self, stage: str) -> Checkpoint:
        """Return the checkpoint of a stage of the training."""
        if self.folder is None:
            return Checkpoint()
        path = self.folder / f"{stage}.safetensors"
        return Checkpoint(path, self.identity, _EVERY, self.describe)

    def describe(self) -> None:
        """Write :data:`DESCRIPTION`."""
        assert self.folder is not None, "a training that writes has a folder"
        content = {**self.identity, "budget": self.budget, "seconds": self.seconds}
        write_json(self.folder / DESCRIPTION, content)

    def fem_runs(
        self,
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
            self.simulator,
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


class Recipe(NamedTuple):
    """A recipe: its options, with their default values, and its function.

    train : from the plan and the job to the trained emulator, with its record.
    """

    options: Plan
    train: Callable[[Any, Job], Emulator]


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
