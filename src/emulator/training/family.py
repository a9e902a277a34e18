"""Pretraining: one network for a family of scenes, to start others from.

One optimiser takes a step on each scene in turn. Each scene keeps its own graph, series and scale;
only the weights are common. Training on a body outside the family then starts from these weights,
with ``train(scene, ..., start=pretrained[0])``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from emulator.core.errors import InputError
from emulator.core.progress import counting
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import State, open_session
from emulator.training.loop import Steps, require_finite, run
from emulator.training.network import NetworkTraining
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
    if not scenes:
        raise InputError("pretraining: no scene is given")
    session = open_session(
        folder,
        "+".join(scene.fingerprint for scene in scenes),
        ", ".join(scene.name for scene in scenes),
        plan,
        architecture,
        resume=resume,
    )
    plan = session.plan
    problems, trainings = _problems(scenes, plan, session.architecture, progress)
    session = replace(session, architecture=problems[0].architecture)
    state = State(*trainings[0].initial())
    state = run(session, state, plan.steps, Steps(trainings), progress=progress, name="pretrain")
    family = [scene.fingerprint for scene in scenes]
    record = {"plan": asdict(plan), "final_loss": require_finite(state), "family": family}
    record["seconds"] = round(session.seconds, 1)
    return [replace(with_weights(p.emulator, state.weights), record=record) for p in problems]


def _problems(
    scenes: Sequence[Scene], plan: Plan, architecture: Architecture | None, progress: bool
) -> tuple[list[Problem], list[NetworkTraining]]:
    """A problem for each scene, all with the first one's untrained weights, and its network's."""
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
    others = counting(scenes[1:], "prepare", disable=not progress)
    # Starting from the first one's network also checks that each scene can have its weights.
    problems = [first, *(prepare(s, plan, architecture, start=first.emulator) for s in others)]
    return problems, [p.training for p in problems if p.training is not None]
