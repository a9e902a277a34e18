"""Training: Adam on a cosine schedule, one processor pass a step, resumable at any moment."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from tqdm import tqdm

from emulator.errors import InputError
from emulator.fem import Simulator
from emulator.network.emulator import Emulator, fresh
from emulator.network.graph import augment
from emulator.network.pignn import Architecture
from emulator.scenes.scene import Scene
from emulator.store import fill_tree, read_arrays, save_tree
from emulator.training.campaign import Runs, run_campaign
from emulator.training.objectives import Batch, Objective, make_loss
from emulator.training.sampling import sobol, uniform

CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class Plan:
    """How to train.

    objective : ``energy`` (no FEM run but the centre), ``simulations``, or ``both``.
    steps : optimiser steps.
    simulations : FEM runs to train on (not used by ``energy``).
    batch : theta a step.
    learning_rate : of Adam at its peak; cosine to zero.
    energy_weight : weight of the energy gap in ``both``.
    centred : start from the FEM solution at the centre of the box rather than from zero.
    checkpoint_every : steps between checkpoints.
    seed : of the weights, the FEM runs' theta, and the batches.
    """

    objective: Objective = "both"
    steps: int = 3000
    simulations: int = 256
    batch: int = 16
    learning_rate: float = 1e-3
    energy_weight: float = 0.02
    centred: bool = True
    checkpoint_every: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        if self.objective not in ("energy", "simulations", "both"):
            raise InputError(f"objective '{self.objective}': use energy, simulations or both")
        for name in ("steps", "batch", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise InputError(f"training: {name} is {getattr(self, name)}; it must be 1 or more")
        if self.objective != "energy" and self.simulations < self.batch:
            raise InputError(
                f"training: {self.simulations} simulations are fewer than a batch of {self.batch}"
            )


@dataclass(frozen=True, eq=False)
class Problem:
    """What the steps of a plan share: an untrained emulator, FEM runs and the step itself."""

    plan: Plan
    emulator: Emulator
    runs: Runs
    step: Callable
    optimiser: optax.GradientTransformation


def prepare(
    scene: Scene, plan: Plan, architecture: Architecture = Architecture(), *, progress: bool = False
) -> Problem:
    """Run the FEM solutions a plan needs and set up its emulator; the same for equal inputs."""
    simulator = Simulator(scene)
    wanted = 0 if plan.objective == "energy" else plan.simulations
    centre = scene.centre[None]
    thetas = jnp.concatenate([centre, sobol(scene, wanted, plan.seed)]) if wanted else centre
    runs = run_campaign(simulator, thetas, progress=progress)
    offset = np.asarray(runs.displacement[0])
    deviation = np.asarray(runs.displacement[1:]) - offset if wanted else 0.2 * offset[None]
    free = ~scene.held
    component = [float(np.sqrt(np.mean(deviation[:, free[:, k], k] ** 2))) for k in range(3)]
    spread = float(np.sqrt(np.mean(np.sum(deviation**2, axis=-1))))
    scale = np.maximum(component, 1e-3 * max(component))
    if not plan.centred:
        offset, scale = np.zeros_like(offset), np.full(3, np.sqrt(np.mean(offset**2)))
    emulator = fresh(scene, augment(scene), architecture, offset, scale, plan.seed)
    energy_scale = float(jnp.abs(runs.energy[0]))
    loss = make_loss(scene, plan.objective, spread, energy_scale, plan.energy_weight)
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.adam(optax.warmup_cosine_decay_schedule(0.0, plan.learning_rate, 100, plan.steps)),
    )
    step = _make_step(emulator, plan, runs, loss, optimiser)
    return Problem(plan, emulator, runs, step, optimiser)


def _make_step(
    emulator: Emulator, plan: Plan, runs: Runs, loss: Callable, optimiser: Any
) -> Callable:
    """``step(weights, state, number) -> (weights, state, loss)``; the batch follows from ``number``."""

    def draw(number: jax.Array) -> Batch:
        key = jax.random.fold_in(jax.random.key(plan.seed), number)
        if plan.objective == "energy":
            return Batch(uniform(emulator.scene, plan.batch, key))
        rows = jax.random.choice(key, len(runs.theta), (plan.batch,), replace=False)
        return Batch(runs.theta[rows], runs.displacement[rows], runs.energy[rows])

    def step(weights: nnx.State, state: Any, number: jax.Array) -> tuple[nnx.State, Any, jax.Array]:
        batch = draw(number)
        value, slope = jax.value_and_grad(lambda w: loss(emulator.predict(w, batch.theta), batch))(weights)
        # A step with a gradient that is not finite is skipped, and shows in the progress bar.
        fine = jnp.isfinite(optax.global_norm(slope))
        slope = jax.tree.map(lambda g: jnp.where(fine, g, 0.0), slope)
        updates, state = optimiser.update(slope, state, weights)
        return optax.apply_updates(weights, updates), state, value

    return jax.jit(step, donate_argnums=(0, 1))


def train(
    scene: Scene,
    plan: Plan,
    folder: str | Path,
    *,
    architecture: Architecture = Architecture(),
    budget: float | None = None,
    progress: bool = False,
    resume: bool = False,
) -> Emulator:
    """Train an emulator.

    Parameters
    ----------
    folder : where checkpoints go. The finished emulator is returned, not written.
    budget : seconds for everything (FEM runs, compilation, training); replaces ``plan.steps`` by
        as many as fit.
    resume : continue from the checkpoint in ``folder``; the result equals that of a run that was
        never interrupted.
    """
    started = time.perf_counter()
    folder = Path(folder)
    checkpoint = folder / CHECKPOINT
    spent, saved = 0.0, None
    if resume:
        saved, metadata = read_arrays(checkpoint)
        plan, spent = _resumed_plan(plan, metadata, scene, checkpoint)
    elif budget is not None:
        plan = replace(plan, steps=_steps_within(budget, scene, plan, architecture, started, progress))
    problem = prepare(scene, plan, architecture, progress=progress)
    weights, state, first = problem.emulator.weights, problem.optimiser.init(problem.emulator.weights), 0
    if saved is not None:
        template = {"weights": weights, "state": state}
        tree = fill_tree(template, saved, str(checkpoint))
        weights, state = jax.tree.map(jnp.asarray, (tree["weights"], tree["state"]))
        first = int(saved["['step']"])
    bar = tqdm(range(first, plan.steps), "train", initial=first, total=plan.steps, disable=not progress)
    losses = []
    for number in bar:
        weights, state, value = problem.step(weights, state, jnp.asarray(number))
        if (number + 1) % 50 == 0 or number + 1 == plan.steps:
            losses.append(float(value))
            bar.set_postfix(loss=f"{losses[-1]:.3e}")
        if (number + 1) % plan.checkpoint_every == 0 and number + 1 < plan.steps:
            elapsed = spent + time.perf_counter() - started
            _write_checkpoint(checkpoint, problem, weights, state, number + 1, elapsed)
    seconds = spent + time.perf_counter() - started
    checkpoint.unlink(missing_ok=True)
    record = {"plan": asdict(plan), "seconds": round(seconds, 1), "final_loss": losses[-1]}
    if not np.isfinite(losses[-1]):
        raise InputError("training ended in a loss that is not finite; lower the learning rate")
    return replace(problem.emulator, weights=weights, record=record)


def _steps_within(
    budget: float, scene: Scene, plan: Plan, architecture: Architecture, started: float, progress: bool
) -> int:
    """How many steps fit in what is left of ``budget`` seconds once set-up has been paid for."""
    problem = prepare(scene, replace(plan, steps=1000), architecture, progress=progress)
    weights, state = problem.emulator.weights, problem.optimiser.init(problem.emulator.weights)
    set_up = time.perf_counter() - started
    durations = []
    for number in range(8):
        begin = time.perf_counter()
        weights, state, value = problem.step(weights, state, jnp.asarray(number))
        value.block_until_ready()
        durations.append(time.perf_counter() - begin)
    compile_time = durations[0]
    # Set-up and compilation come once more: the plan with its true length is prepared afresh.
    left = 0.98 * budget - (time.perf_counter() - started) - set_up - compile_time
    steps = int(left / float(np.median(durations[1:])))
    if steps < 100:
        raise InputError(
            f"a budget of {budget:.0f} s leaves {max(steps, 0)} training steps; give at least "
            f"{budget - left + 100 * float(np.median(durations[1:])):.0f} s"
        )
    return steps


def _write_checkpoint(
    path: Path, problem: Problem, weights: Any, state: Any, step: int, seconds: float
) -> None:
    metadata = {
        "plan": json.dumps(asdict(problem.plan)),
        "fingerprint": problem.emulator.scene.fingerprint,
        "seconds": repr(seconds),
    }
    save_tree(path, {"weights": weights, "state": state, "step": np.asarray(step)}, metadata)


def _resumed_plan(plan: Plan, metadata: dict, scene: Scene, path: Path) -> tuple[Plan, float]:
    """The plan a checkpoint was written under, and the seconds already spent."""
    if metadata.get("fingerprint") != scene.fingerprint:
        raise InputError(f"{path} belongs to another scene than '{scene.name}'; train afresh")
    return Plan(**json.loads(metadata["plan"])), float(metadata["seconds"])
