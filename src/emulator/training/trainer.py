"""The list of all recipes, and training by one of them, which can be killed and resumed.

The way from ``calibrate train SCENE --recipe X --out DIR`` to an emulator::

    train               checks the inputs; DIR/checkpoint/training.json says whose checkpoint it is
    RECIPES[X].train    runs its stages, each of which keeps its state in DIR/checkpoint, if any:
                        sweeps -> sweeps.safetensors, optimiser steps -> steps.safetensors
    save_emulator       DIR/emulator.json and DIR/weights.safetensors
    remove_checkpoint   DIR/checkpoint goes

To add a recipe, write a dataclass of its options and a function in a file of its own, and add both
to ``RECIPES``; the command line then knows it.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.checkpoint import FORMAT
from emulator.core.errors import InputError, look_up
from emulator.core.rooms import offered
from emulator.core.schema import read_as
from emulator.core.store import read_json
from emulator.fem.campaign import StoredRuns
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.job import DESCRIPTION, Job, Recipe
from emulator.training.mechanics import MECHANICS
from emulator.training.plan import Plan
from emulator.training.two_meshes import TWO_MESHES

_FOLDER = "checkpoint"
_ALL: tuple[Recipe, ...] = (
    MECHANICS,
    TWO_MESHES,
    *offered("emulator.training.physics", "PHYSICS"),
    *offered("emulator.training.sweeps", "SWEEPS"),
    *offered("emulator.training.paper", "PAPER"),
)
RECIPES: dict[str, Recipe] = {entry.options.recipe: entry for entry in _ALL}


def recipe(name: str) -> Any:  # a Plan; each has options of its own, which ``replace`` takes
    """Return the options of that recipe; ``dataclasses.replace`` changes them."""
    return look_up(RECIPES, name, "recipe").options


def plan_of(options: Mapping[str, Any]) -> Plan:
    """Return the plan with these options, as an emulator's record has them."""
    name = options.get("recipe", "")
    return read_as(type(recipe(name)), dict(options), f"recipe '{name}'")


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
    folder : the folder of the checkpoint; :func:`remove_checkpoint` once the emulator is saved.
    architecture : the sizes of the network; by default the recipe's.
    start : the emulator to begin from: of recipes sweeps and mechanics, one with the network of a
        family of bodies; of sweeps and two_meshes, that on the coarser mesh.
    campaign : FEM runs to take the first ``plan.simulations`` of, instead of making them; needed
        again to resume.
    budget : seconds for everything, compilation included. It replaces ``plan.steps`` by as many as
        fit, and ``plan.simulations`` by as many as were done in its first third.
    progress : whether progress is shown.
    resume : continue from the checkpoint, under its plan and sizes; ``start`` is needed again.
        Without a budget the result equals that of a training never interrupted. One on a budget
        has what was left of it, or the new ``budget`` from now on.
    """
    if not resume:
        _check_inputs(plan, architecture, start, campaign)
    identity: dict[str, Any] = {
        "format": FORMAT,
        "scene": scene.fingerprint,
        "plan": asdict(replace(plan, campaign="" if campaign is None else campaign.digest)),
        "architecture": None if architecture is None else asdict(architecture),
        "start": None if start is None else start.fingerprint,
    }
    folder, spent, limit = Path(folder) / _FOLDER, 0.0, np.inf if budget is None else budget
    if resume:
        description = _description(folder / DESCRIPTION, scene.name, identity)
        spent, before = description.pop("seconds"), description.pop("budget")
        limit = spent + limit if budget is not None else np.inf if before is None else before
        identity = description
    began = time.perf_counter() - spent
    sizes = identity["architecture"] and read_as(Architecture, identity["architecture"], "sizes")
    as_json = json.loads(json.dumps(identity))
    job = Job(scene, sizes, start, campaign, folder, as_json, limit, began, progress)
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
    plan = plan_of(identity["plan"])
    emulator = RECIPES[plan.recipe].train(plan, job)
    job.describe()
    record = {**emulator.record, "seconds": round(job.seconds, 1)}
    if start is not None:
        of = {"scene": start.scene.name, "scene_fingerprint": start.scene.fingerprint}
        record["start"] = {**of, "fingerprint": start.fingerprint}
    return replace(emulator, record=record)


def _check_inputs(
    plan: Plan,
    architecture: Architecture | None,
    start: Emulator | None,
    campaign: StoredRuns | None,
) -> None:
    """Refuse what the recipe has no use for."""
    if campaign is not None and not plan.runs:
        raise InputError(f"training: recipe '{plan.recipe}' takes no FEM runs, so no campaign")
    if architecture is not None and not plan.trains_network:
        raise InputError(f"training: recipe '{plan.recipe}' trains no network, so no architecture")
    if start is not None and plan.trains_network:
        raise InputError(
            f"training: recipe '{plan.recipe}' trains its network from nothing, so it has no "
            "start; sweeps and mechanics begin from the network of a family of bodies"
        )


def _description(path: Path, name: str, now: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of the training to resume; refuse another scene's, runs' or start's.

    name, now : the name of the scene, and the identity that the training would have from now on.
    """
    if not path.is_file():
        raise InputError(f"nothing to resume: {path} does not exist; train afresh")
    description = read_json(path)
    expected = {*now, "budget", "seconds"}
    if not isinstance(description, dict) or description.keys() != expected:
        raise InputError(f"{path} has not the entries {', '.join(sorted(expected))}; train afresh")
    if description["format"] != FORMAT:
        raise InputError(f"{path} has format {description['format']}, not {FORMAT}; train afresh")
    if description["scene"] != now["scene"]:
        raise InputError(f"{path} belongs to another scene than '{name}'; train afresh")
    if (runs := description["plan"].get("campaign", "")) != now["plan"]["campaign"]:
        source = f"FEM runs of a {'campaign' if runs else 'design'}"
        raise InputError(f"{path}: the training was begun on {source}; resume it with the same")
    if description["start"] != now["start"]:
        raise InputError(
            f"{path}: the training stands on another emulator than is given as the start; resume "
            "it with the same"
        )
    return description


def remove_checkpoint(folder: str | Path) -> None:
    """Remove the checkpoint of the training in ``folder``, if any."""
    shutil.rmtree(Path(folder) / _FOLDER, ignore_errors=True)
