"""Pretraining: one network for a family of scenes, to start others from.

One optimiser walks through the scenes in turn. Each keeps its own graph, series and scale; only the
weights are common. A body the family never saw then starts from these, with
``train(scene, ..., start=pretrained[0])``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from emulator.errors import InputError, SolverError
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.checkpoint import CHECKPOINT, read_checkpoint, write_checkpoint
from emulator.training.plan import Plan
from emulator.training.trainer import prepare


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
    plan : with a network and no residual. ``plan.steps`` counts the steps of all scenes together,
        each of which takes the next scene; FEM runs, if any, are solved on every scene.
    folder : where checkpoints go, as in :func:`~emulator.training.train`.
    resume : continue from the checkpoint in ``folder``, under the plan it was written with.
    """
    started = time.perf_counter()
    checkpoint = Path(folder) / CHECKPOINT
    if not scenes:
        raise InputError("pretraining: no scene is given")
    fingerprint = "+".join(scene.fingerprint for scene in scenes)
    names = ", ".join(scene.name for scene in scenes)
    saved = read_checkpoint(checkpoint, fingerprint, names) if resume else None
    if saved:
        plan, architecture = saved.plan, saved.architecture or architecture
    if plan.residual:
        raise InputError(
            f"pretraining: recipe '{plan.recipe}' learns a residual, which belongs to one scene; "
            "use recipe network or paper"
        )
    problems = [prepare(scenes[0], plan, architecture)]
    for scene in tqdm(scenes[1:], "prepare", disable=not progress):
        # From the first one's network: as well as the same weights, the same demands on the scene.
        problems.append(prepare(scene, plan, architecture, start=problems[0].emulator))
    weights = jax.tree.map(jnp.copy, problems[0].emulator.weights)
    state = problems[0].optimiser.init(weights)
    spent, first, value = 0.0, 0, float("nan")
    if saved:
        weights, state = saved.restore(weights, state)
        spent, first, value = saved.seconds, saved.step, saved.loss
    sizes = problems[0].emulator.architecture
    bar = tqdm(desc="pretrain", initial=first, total=plan.steps, disable=not progress)
    for number in range(first, plan.steps):
        step, done = problems[number % len(problems)].step, number + 1
        weights, state, loss = step(weights, state, jnp.asarray(number), jnp.asarray(plan.steps))
        bar.update()
        if done % plan.checkpoint_every == 0 or done == plan.steps:
            value = float(loss)
            seconds = spent + time.perf_counter() - started
            at = (weights, state, done)
            write_checkpoint(checkpoint, fingerprint, plan, sizes, {}, at, seconds, value)
    bar.close()
    if not np.isfinite(value):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    record = {
        "plan": asdict(plan),
        "final_loss": value,
        "family": [scene.fingerprint for scene in scenes],
        "seconds": round(spent + time.perf_counter() - started, 1),
    }
    return [replace(p.emulator, weights=weights, record=record) for p in problems]
