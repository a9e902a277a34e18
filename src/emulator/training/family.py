"""Pretraining: one network for a family of scenes, to start others from.

One optimiser takes a step on each scene in turn. Each scene keeps its own graph, series and scale;
only the weights are common. Training on a body outside the family then starts from these weights,
with ``train(scene, ..., start=pretrained[0])``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from tqdm import tqdm

from emulator.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import CHECKPOINT, State, Writer, read_checkpoint
from emulator.training.loop import Bar, Keep, Steps, optimise, require_finite
from emulator.training.plan import Plan
from emulator.training.problem import Problem, prepare
from emulator.training.start import with_weights


def pretrain(
    scenes: Sequence[Scene],
    plan: Plan,
    folder: str | Path,
    *,
    architecture: Architecture | None = None,
    progress: bool = False,
    resume: bool = False,
) -> list[Emulator]:
    """Train one network on several scenes; an emulator of each, all with the same weights.

    Parameters
    ----------
    scenes : of equal parameters; meshes and their topology may differ. The step is compiled once
        for each.
    plan : with a network and no discrepancy model. ``plan.steps`` counts the steps of all scenes
        together, each of which takes the next scene; FEM runs, if any, are solved on every scene.
    folder : where checkpoints go, as in :func:`~emulator.training.train`.
    resume : continue from the checkpoint in ``folder``, under the plan it was written with.
    """
    path, began = Path(folder) / CHECKPOINT, time.perf_counter()
    if not scenes:
        raise InputError("pretraining: no scene is given")
    fingerprint = "+".join(scene.fingerprint for scene in scenes)
    saved = None
    if resume:
        saved = read_checkpoint(path, fingerprint, ", ".join(scene.name for scene in scenes))
    if saved is not None:
        plan, architecture = saved.plan, saved.architecture or architecture
    problems = _problems(scenes, plan, architecture, progress)
    spent = saved.seconds if saved is not None else 0.0
    clock = lambda: spent + time.perf_counter() - began  # noqa: E731
    keep = Keep(Writer(path, fingerprint, problems[0].architecture), plan, clock)
    state = State(*problems[0].initial())
    state = state if saved is None else saved.restore(*state[:2])
    with Bar("pretrain", state, plan.steps, shown=progress) as bar:
        state = optimise(state, plan.steps, Steps(problems), [bar, keep])
    family = [scene.fingerprint for scene in scenes]
    record = {"plan": asdict(plan), "final_loss": require_finite(state), "family": family}
    record["seconds"] = round(clock(), 1)
    return [replace(with_weights(p.emulator, state.weights), record=record) for p in problems]


def _problems(
    scenes: Sequence[Scene], plan: Plan, architecture: Architecture | None, progress: bool
) -> list[Problem]:
    """A problem for each scene, all with the first one's untrained weights."""
    if plan.discrepancy:
        raise InputError(
            f"pretraining: recipe '{plan.recipe}' fits a discrepancy model, which belongs to one "
            "scene; use recipe network or paper"
        )
    if plan.objective == "modes":
        raise InputError(
            f"pretraining: recipe '{plan.recipe}' solves for the last layer of one scene; "
            "use recipe network or paper"
        )
    first = prepare(scenes[0], plan, architecture)
    others = tqdm(scenes[1:], "prepare", disable=not progress)
    # Starting from the first one's network also checks that each scene can have its weights.
    return [first, *(prepare(s, plan, architecture, start=first.emulator) for s in others)]
