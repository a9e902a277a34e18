"""The list of all recipes, and training by one of them, which can be killed and resumed.

To add a recipe, write a subclass of :class:`~emulator.training.plan.Plan` in a file of its own, and
add it to ``RECIPES``; the command line then knows it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.rooms import offered
from emulator.core.schema import read_as
from emulator.fem.campaign import StoredRuns
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import CHECKPOINT, SWEEPS, Session
from emulator.training.mechanics import Mechanics
from emulator.training.plan import Job, Plan
from emulator.training.two_meshes import TwoMeshes

_ALL: tuple[type[Plan], ...] = (
    Mechanics,
    TwoMeshes,
    *offered("emulator.training.physics", "PhysicsPlan"),
    *offered("emulator.training.sweeps", "Sweeps"),
    *offered("emulator.training.paper", "Paper"),
)
RECIPES: dict[str, Plan] = {kind.recipe: kind() for kind in _ALL}


def recipe(name: str) -> Any:  # a Plan; each has options of its own, which ``replace`` takes
    """Return the plan of that recipe; ``dataclasses.replace`` changes its options."""
    return look_up(RECIPES, name, "recipe")


def plan_of(options: Mapping[str, Any]) -> Plan:
    """Return the plan with these options, as an emulator's record has them."""
    kind = type(recipe(options["recipe"]))
    return read_as(kind, dict(options), f"recipe '{options['recipe']}'")


def train(
    scene: Scene,
    plan: Plan,
    folder: str | Path,
    *,
    architecture: Architecture | None = None,
    start: Emulator | None = None,
    campaign: StoredRuns | None = None,
    budget: float | None = None,
    progress: bool = False,
    resume: bool = False,
) -> Emulator:
    """Train an emulator.

    Parameters
    ----------
    scene : the scene to emulate.
    plan : the recipe and its options, e.g. ``recipe("mechanics")``.
    folder : the folder of the checkpoints. The finished emulator is returned, not written; remove
        the last checkpoint with :func:`remove_checkpoint` once it is safe.
    architecture : the sizes of the network; by default the recipe's.
    start : the emulator to begin from: of recipes sweeps and mechanics, one with the network of a
        family of bodies; of sweeps and two_meshes, that on the coarser mesh, which recipe mechanics
        makes for two_meshes if none is given.
    campaign : FEM runs to take the first ``plan.simulations`` of, instead of making them; needed
        again to resume.
    budget : seconds for everything (FEM runs, compilation, training). It replaces ``plan.steps`` by
        as many as fit, estimated again as the machine gets busier or less so, and
        ``plan.simulations`` by as many as were done in its first third.
    progress : whether progress bars are shown.
    resume : continue from the checkpoint in ``folder``, among sweeps or steps, under the plan it
        was written with and with the network it holds; where no network is trained, ``start`` is
        needed again. For a plan in steps the result equals that of a run never interrupted; one on
        a budget keeps the number of steps it was aiming at, and killed among its sweeps goes on
        without the budget.
    """
    folder = Path(folder)
    if campaign is not None and not (plan.runs or resume):
        raise InputError(f"training: recipe '{plan.recipe}' takes no FEM runs, so no campaign")
    if architecture is not None and not (plan.trains_network or resume):
        raise InputError(f"training: recipe '{plan.recipe}' trains no network, so no architecture")
    if start is not None and plan.trains_network:
        raise InputError(
            f"training: recipe '{plan.recipe}' trains its network from nothing, so it has no "
            "start; sweeps and mechanics begin from the network of a family of bodies"
        )
    session = Session(folder / CHECKPOINT, scene.fingerprint, plan, architecture)
    if resume:
        kinds = {name: type(default) for name, default in RECIPES.items()}
        session, budget = session.resumed(scene.name, kinds), None  # the checkpoint has the budget
    seconds = np.inf if budget is None else budget
    sizes = session.architecture
    job = Job(scene, sizes, start, campaign, folder, seconds, session.began, progress)
    if start is None:
        job = replace(job, start=session.plan.default_start(job, resume=resume))
    source = {}
    if job.start is not None:
        of = job.start.scene
        source = {"scene": of.name, "scene_fingerprint": of.fingerprint}
        source |= {"fingerprint": job.start.fingerprint}
    digest = "" if campaign is None else campaign.digest
    if resume:
        _check_same(session, digest, source)
    else:
        session = replace(session, plan=replace(plan, campaign=digest), start=source)
        (folder / SWEEPS).unlink(missing_ok=True)
    return session.finished(*session.plan.train(job, session))


def _check_same(session: Session, digest: str, start: Mapping[str, Any]) -> None:
    """Refuse to resume with other FEM runs, or on another emulator."""
    plan = session.plan
    if plan.campaign != digest:
        source = "FEM runs of a campaign" if plan.campaign else "FEM runs of its own"
        raise InputError(f"the checkpoint was trained on {source}; resume it with the same")
    if session.start != start:
        raise InputError(
            "the checkpoint stands on another emulator than is given as the start; resume it with "
            "the same"
        )
