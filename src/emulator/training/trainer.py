"""Training: Adam on a cosine schedule, one processor pass a step, resumable at any moment."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from tqdm import tqdm

from emulator.errors import InputError, SolverError
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
WARMUP = 100
# Without FEM runs the spread of the displacements is unknown; this much of the centre's will do.
_GUESS = 0.2


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
    energy_weight: float = 0.3
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
    """What training works on: an untrained emulator, FEM runs, and one optimiser step.

    ``step(weights, state, number, total) -> (weights, state, loss)``; its batch and its learning
    rate follow from ``number`` and ``total`` alone, so that a resumed run repeats them.
    """

    emulator: Emulator
    runs: Runs
    optimiser: optax.GradientTransformation
    step: Callable[..., tuple[nnx.State, Any, jax.Array]]


def prepare(
    scene: Scene,
    plan: Plan,
    architecture: Architecture | None = None,
    *,
    progress: bool = False,
) -> Problem:
    """Run the FEM solutions a plan needs and set up its emulator; the same for equal inputs."""
    wanted = 0 if plan.objective == "energy" else plan.simulations
    centre = scene.centre[None]
    thetas = jnp.concatenate([centre, sobol(scene, wanted, plan.seed)]) if wanted else centre
    runs = run_campaign(Simulator(scene), thetas, progress=progress)
    offset = np.asarray(runs.displacement[0])
    deviation = np.asarray(runs.displacement[1:]) - offset if wanted else _GUESS * offset[None]
    free = ~scene.held
    component = [float(np.sqrt(np.mean(deviation[:, free[:, k], k] ** 2))) for k in range(3)]
    spread = float(np.sqrt(np.mean(np.sum(deviation**2, axis=-1))))
    scale = np.maximum(component, 1e-3 * max(component))
    if not plan.centred:
        offset, scale = np.zeros_like(offset), np.full(3, np.sqrt(np.mean(offset**2)))
    emulator = fresh(
        scene, augment(scene), architecture or Architecture(), offset, scale, plan.seed
    )
    energy_scale = float(jnp.abs(runs.energy[0]))
    loss = make_loss(scene, plan.objective, spread, energy_scale, plan.energy_weight)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    return Problem(emulator, runs, optimiser, _make_step(emulator, plan, runs, loss, optimiser))


def _make_step(
    emulator: Emulator,
    plan: Plan,
    runs: Runs,
    loss: Callable[[jax.Array, Batch], jax.Array],
    optimiser: optax.GradientTransformation,
) -> Callable[..., tuple[nnx.State, Any, jax.Array]]:
    def draw(number: jax.Array) -> Batch:
        key = jax.random.fold_in(jax.random.key(plan.seed), number)
        if plan.objective == "energy":
            nothing = jnp.zeros(0)
            return Batch(uniform(emulator.scene, plan.batch, key), nothing, nothing)
        rows = jax.random.choice(key, len(runs.theta), (plan.batch,), replace=False)
        return Batch(runs.theta[rows], runs.displacement[rows], runs.energy[rows])

    def step(
        weights: nnx.State, state: Any, number: jax.Array, total: jax.Array
    ) -> tuple[nnx.State, Any, jax.Array]:
        batch = draw(number)
        value, slope = jax.value_and_grad(lambda w: loss(emulator.predict(w, batch.theta), batch))(
            weights
        )
        updates, moved = optimiser.update(slope, state, weights)
        rate = learning_rate(plan.learning_rate, number, total)
        updates = jax.tree.map(lambda d: (-rate * d).astype(d.dtype), updates)
        new = optax.apply_updates(weights, updates), moved
        # A step whose gradient is not finite is not taken.
        fine = jnp.isfinite(optax.tree.norm(slope))
        weights, state = jax.tree.map(lambda a, b: jnp.where(fine, a, b), new, (weights, state))
        return weights, state, value

    return jax.jit(step, donate_argnums=(0, 1))


def learning_rate(peak: float, number: jax.Array, total: jax.Array) -> jax.Array:
    """Linear warm-up over ``WARMUP`` steps to ``peak``, then a cosine to zero at ``total``."""
    warm = jnp.minimum(1.0, (number + 1) / WARMUP)
    return peak * warm * 0.5 * (1.0 + jnp.cos(jnp.pi * number / total))


def train(
    scene: Scene,
    plan: Plan,
    folder: str | Path,
    *,
    architecture: Architecture | None = None,
    budget: float | None = None,
    progress: bool = False,
    resume: bool = False,
) -> Emulator:
    """Train an emulator.

    Parameters
    ----------
    folder : where checkpoints go. The finished emulator is returned, not written; remove the last
        checkpoint with :func:`remove_checkpoint` once it is safe.
    budget : seconds for everything (FEM runs, compilation, training); replaces ``plan.steps`` by
        as many as fit, aimed again as the machine gets busier or less so.
    resume : continue from the checkpoint in ``folder``, under the plan it was written with. For a
        plan in steps the result equals that of a run never interrupted; one on a budget keeps the
        number of steps it was aiming at.
    """
    started = time.perf_counter()
    checkpoint = Path(folder) / CHECKPOINT
    saved = _read_checkpoint(checkpoint, scene) if resume else None
    plan = saved.plan if saved else plan
    spent = saved.seconds if saved else 0.0
    problem = prepare(scene, plan, architecture, progress=progress)
    weights, first = problem.emulator.weights, 0
    state = problem.optimiser.init(weights)
    if saved:
        tree = fill_tree({"weights": weights, "state": state}, saved.arrays, str(checkpoint))
        weights, state = jax.tree.map(jnp.asarray, (tree["weights"], tree["state"]))
        first = int(saved.arrays["['step']"])
    elif budget is not None:
        left = budget - (time.perf_counter() - started)
        plan = replace(plan, steps=_steps_within(left, problem, plan.steps))
    deadline = None if budget is None or saved else started + 0.99 * budget
    bar = tqdm(desc="train", initial=first, total=plan.steps, disable=not progress)
    done, loss, began = first, float("nan"), time.perf_counter()
    while done < plan.steps:
        arguments = (jnp.asarray(done), jnp.asarray(plan.steps))
        weights, state, value = problem.step(weights, state, *arguments)
        done += 1
        bar.update()
        if done % 50 == 0 or done == plan.steps:
            loss = float(value)
            bar.set_postfix(loss=f"{loss:.3e}")
        if deadline is not None and done % 200 == 0:
            # The machine may have become busier, or less so: aim again at the deadline.
            now = time.perf_counter()
            left = int((deadline - now) / ((now - began) / (done - first)))
            plan = replace(plan, steps=done + max(left, 0))
            bar.total = plan.steps
        if done % plan.checkpoint_every == 0 and done < plan.steps:
            seconds = spent + time.perf_counter() - started
            _write_checkpoint(checkpoint, scene, plan, (weights, state, done), seconds)
    bar.close()
    if not np.isfinite(loss):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    seconds = round(spent + time.perf_counter() - started, 1)
    record = {"plan": asdict(plan), "seconds": seconds, "final_loss": loss}
    return replace(problem.emulator, weights=weights, record=record)


def remove_checkpoint(folder: str | Path) -> None:
    """Remove the checkpoint in ``folder``, if there is one."""
    (Path(folder) / CHECKPOINT).unlink(missing_ok=True)


def _steps_within(seconds: float, problem: Problem, total: int) -> int:
    """How many steps fit into ``seconds``, from a few of them; their effect is thrown away."""
    started = time.perf_counter()
    weights = jax.tree.map(jnp.copy, problem.emulator.weights)  # a step consumes its arguments
    state = problem.optimiser.init(weights)
    durations = []
    for number in range(8):
        begin = time.perf_counter()
        arguments = (jnp.asarray(number), jnp.asarray(total))
        weights, state, value = problem.step(weights, state, *arguments)
        value.block_until_ready()
        durations.append(time.perf_counter() - begin)
    one = float(np.median(durations[1:]))
    left = 0.98 * seconds - (time.perf_counter() - started)
    steps = int(left / one)
    if steps < WARMUP:
        raise InputError(
            f"the budget leaves {max(steps, 0)} training steps of {1e3 * one:.0f} ms after FEM "
            f"runs and compilation; give at least {WARMUP * one - left:.0f} s more"
        )
    return steps


class _Checkpoint(NamedTuple):
    plan: Plan
    seconds: float
    arrays: dict[str, np.ndarray]


def _write_checkpoint(
    path: Path, scene: Scene, plan: Plan, progress: tuple[Any, Any, int], seconds: float
) -> None:
    weights, state, step = progress
    metadata = {
        "plan": json.dumps(asdict(plan)),
        "fingerprint": scene.fingerprint,
        "seconds": repr(seconds),
    }
    save_tree(path, {"weights": weights, "state": state, "step": np.asarray(step)}, metadata)


def _read_checkpoint(path: Path, scene: Scene) -> _Checkpoint:
    if not path.is_file():
        raise InputError(f"nothing to resume: checkpoint {path} does not exist")
    arrays, metadata = read_arrays(path)
    if metadata.get("fingerprint") != scene.fingerprint:
        raise InputError(f"{path} belongs to another scene than '{scene.name}'; train afresh")
    return _Checkpoint(Plan(**json.loads(metadata["plan"])), float(metadata["seconds"]), arrays)
