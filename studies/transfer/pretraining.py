"""Pretraining: one network for several scenes, to start others from.

One optimiser takes a step on each scene in turn. Each scene keeps its own graph, series and scale;
only the weights are common. Training on another body then starts from these weights, with
``train(scene, ..., start=pretrained[0])``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from emulator.core.display import counting
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import CHECKPOINT, Session, State
from emulator.training.graph_network import GraphNetwork
from emulator.training.network_plan import with_weights
from emulator.training.optimiser import run
from emulator.training.plan import Job


def pretrain(
    scenes: Sequence[Scene],
    plan: GraphNetwork,
    folder: str | Path,
    *,
    architecture: Architecture | None = None,
    progress: bool = False,
    resume: bool = False,
) -> list[Emulator]:
    """Train one network on several scenes; return an emulator of each, with the same weights.

    Parameters
    ----------
    scenes : scenes of equal parameters; their meshes may differ. The step is compiled for each.
    plan : the options of the network. ``plan.steps`` counts the steps of all scenes together, each
        of which takes the next scene; FEM runs, if any, are solved on every scene.
    folder : the folder of the checkpoints.
    architecture : the sizes of the network.
    progress : whether progress bars are shown.
    resume : continue from the checkpoint in ``folder``, under the plan it was written with.
    """
    if not scenes:
        raise InputError("pretraining: no scene is given")
    fingerprint = "+".join(scene.fingerprint for scene in scenes)
    session = Session(Path(folder) / CHECKPOINT, fingerprint, plan, architecture)
    if resume:
        kinds = {"network": GraphNetwork, "paper": GraphNetwork}
        session = session.resumed(", ".join(scene.name for scene in scenes), kinds)
    assert isinstance(session.plan, GraphNetwork), "no other plan is written here"
    plan = session.plan
    first = plan.prepare(Job(scenes[0], session.architecture))
    others = counting(scenes[1:], "prepare", disable=not progress)
    # Starting from the first one's network also checks that each scene can have its weights.
    rest = [plan.prepare(Job(s, session.architecture, first.emulator)) for s in others]
    problems = [first, *rest]
    session = replace(session, architecture=first.training.network.architecture)

    def advance(state: State, total: int) -> State:
        """The next step, of the next scene in turn."""
        return problems[state.done % len(problems)].training.advance(state, total)

    initial = first.training.initial()
    state = run(session, initial, plan.steps, advance, progress=progress)
    record = {
        **plan.record(state.loss),
        "family": [scene.fingerprint for scene in scenes],
        "seconds": round(session.seconds, 1),
    }
    return [replace(with_weights(p.emulator, state.weights), record=record) for p in problems]
