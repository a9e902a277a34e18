"""Training: Adam, one processor pass a step, then the residual; resumable at any moment."""

from __future__ import annotations

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

from emulator.errors import InputError, SolverError
from emulator.fem import Simulator
from emulator.fem.campaign import Runs, run_campaign
from emulator.fem.designs import design, sobol, uniform
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import BASES, Emulator, fresh
from emulator.surrogates.network.graph import augment
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import constant, expand
from emulator.training.basis import mechanical_modes
from emulator.training.checkpoint import CHECKPOINT, read_checkpoint, write_checkpoint
from emulator.training.discrepancy_stage import FEWEST, add_residual, rounded
from emulator.training.objectives import Batch, Scales, make_loss, mean_square_gradient
from emulator.training.plan import Plan
from emulator.training.start import architecture_from, start_record, with_network_of

WARMUP = 100
# Without FEM runs the spread of the displacements is unknown; this much of the centre's will do.
_GUESS = 0.2
# Parts of a time budget: until when FEM runs may start, and until when the network trains.
_FEM_SHARE = 0.3
_NETWORK_SHARE = 0.85

_NO_NETWORK = Architecture(steps=0, latent=1, hidden=(1,), modes=0)

Weights = nnx.State
Step = Callable[..., tuple[Weights, Any, jax.Array]]


@dataclass(frozen=True, eq=False)
class Problem:
    """What training works on: an untrained emulator, FEM runs, and one optimiser step.

    ``step(weights, state, number, total) -> (weights, state, loss)``; its batch and its learning
    rate follow from ``number`` and ``total`` alone, so that a resumed run repeats them.
    With the decoder's prepared part as a last argument, a step leaves that as it is.
    """

    emulator: Emulator
    runs: Runs
    optimiser: optax.GradientTransformation
    step: Step


def prepare(
    scene: Scene,
    plan: Plan,
    architecture: Architecture | None = None,
    *,
    start: Emulator | None = None,
    deadline: float = np.inf,
    progress: bool = False,
) -> Problem:
    """Run the FEM solutions a plan needs and set up its emulator; the same for equal inputs.

    Parameters
    ----------
    start : the emulator whose network to begin from, on whatever mesh; its architecture then is
        the default.
    deadline : of the performance counter, after which no FEM run is begun, the fewest that a
        residual can be judged by excepted.
    """
    if start is not None:
        architecture = architecture_from(start, scene, plan, architecture)
    simulator = Simulator(scene)
    # Rounded to what a file keeps, so that the residual is fitted to what will be loaded.
    series = rounded(expand(simulator, order=plan.order)) if plan.order else None
    thetas = scene.centre[None]
    if plan.runs:
        draw = design if plan.residual else sobol
        thetas = jnp.concatenate([thetas, draw(scene, plan.runs, plan.seed)])
    runs = run_campaign(
        simulator,
        thetas,
        slopes=plan.residual,
        predictor=series,
        deadline=deadline,
        at_least=FEWEST + 1,
        progress=progress,
    )
    scale, scales = _scales(scene, plan, runs)
    if series is None:
        u = runs.displacement[0]
        centre = np.asarray(scene.to_unit(scene.centre))
        series = constant(centre, u if plan.centred else jnp.zeros_like(u))
    architecture = architecture or (Architecture() if plan.steps else _NO_NETWORK)
    architecture = replace(architecture, decoder=plan.decoder)
    basis = None
    if plan.decoder == "separable":
        basis = (mechanical_modes(simulator, series, plan.modes) / scale).astype(np.float32)
    emulator = fresh(scene, augment(scene), architecture, series, scale, plan.seed, basis)
    if start is not None:
        emulator = with_network_of(emulator, start)
    loss = make_loss(scene, plan.objective, scales, plan.energy_weight)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    return Problem(emulator, runs, optimiser, _make_step(emulator, plan, runs, loss, optimiser))


def _scales(scene: Scene, plan: Plan, runs: Runs) -> tuple[np.ndarray, Scales]:
    """Of the network's output by component, (3,) mm, and of the loss, from what runs differ by."""
    centre = np.asarray(runs.displacement[0])
    known = len(runs.theta) > 1 and plan.objective != "energy"
    deviation = np.asarray(runs.displacement[1:]) - centre if known else _GUESS * centre[None]
    free = ~scene.held
    component = [float(np.sqrt(np.mean(deviation[:, free[:, k], k] ** 2))) for k in range(3)]
    scales = Scales(
        displacement=float(np.sqrt(np.mean(np.sum(deviation**2, axis=-1)))),
        gradient=float(jnp.sqrt(mean_square_gradient(scene, jnp.asarray(deviation)))),
        energy=float(jnp.abs(runs.energy[0])),
    )
    if not plan.centred:
        return np.full(3, np.sqrt(np.mean(centre**2))), scales
    return np.maximum(component, 1e-3 * max(component)), scales


def _make_step(
    emulator: Emulator,
    plan: Plan,
    runs: Runs,
    loss: Callable[[jax.Array, Batch], jax.Array],
    optimiser: optax.GradientTransformation,
) -> Step:
    def draw(number: jax.Array) -> Batch:
        key = jax.random.fold_in(jax.random.key(plan.seed), number)
        if plan.objective == "energy":
            nothing = jnp.zeros(0)
            return Batch(uniform(emulator.scene, plan.batch, key), nothing, nothing)
        rows = jax.random.choice(key, len(runs.theta), (plan.batch,), replace=False)
        return Batch(runs.theta[rows], runs.displacement[rows], runs.energy[rows])

    def decoded(weights: Weights, thetas: jax.Array, kept: jax.Array) -> jax.Array:
        decoder = nnx.merge(emulator.definition, weights).decoder
        return emulator.decode(decoder, kept, thetas)

    def step(
        weights: Weights, state: Any, number: jax.Array, total: jax.Array, *kept: jax.Array
    ) -> tuple[Weights, Any, jax.Array]:
        batch = draw(number)
        predict = decoded if kept else emulator.predict
        value, slope = jax.value_and_grad(lambda w: loss(predict(w, batch.theta, *kept), batch))(
            weights
        )
        updates, moved = optimiser.update(slope, state, weights)
        rate = learning_rate(plan, number, total)
        updates = jax.tree.map(lambda d: (-rate * d).astype(d.dtype), updates)
        if kept:
            # Momentum would go on moving what the kept modes were made from.
            updates = jax.tree_util.tree_map_with_path(_branch_only, updates)
        new = optax.apply_updates(weights, updates), moved
        # A step whose gradient is not finite is not taken.
        fine = jnp.isfinite(optax.tree.norm(slope))
        weights, state = jax.tree.map(lambda a, b: jnp.where(fine, a, b), new, (weights, state))
        return weights, state, value

    return jax.jit(step, donate_argnums=(0, 1))


def _branch_only(path: Any, update: jax.Array) -> jax.Array:
    return update if "'branch'" in jax.tree_util.keystr(path) else jnp.zeros_like(update)


def learning_rate(plan: Plan, number: jax.Array, total: jax.Array) -> jax.Array:
    """Of step ``number``: see :class:`Plan`; a cosine follows ``WARMUP`` steps of warm-up."""
    peak = plan.learning_rate
    if plan.schedule == "halves":
        return jnp.where(number < total // 2, peak, 0.1 * peak)
    warm = jnp.minimum(1.0, (number + 1) / WARMUP)
    return peak * warm * 0.5 * (1.0 + jnp.cos(jnp.pi * number / total))


def train(
    scene: Scene,
    plan: Plan,
    folder: str | Path,
    *,
    architecture: Architecture | None = None,
    start: Emulator | None = None,
    budget: float | None = None,
    progress: bool = False,
    resume: bool = False,
) -> Emulator:
    """Train an emulator.

    Parameters
    ----------
    folder : where checkpoints go. The finished emulator is returned, not written; remove the last
        checkpoint with :func:`remove_checkpoint` once it is safe.
    start : begin from the network of this emulator, which may be of another geometry.
    budget : seconds for everything (FEM runs, compilation, training, the residual); replaces
        ``plan.steps`` by as many as fit, aimed again as the machine gets busier or less so, and
        ``plan.simulations`` by as many as were done in its first third. Where a residual follows,
        which soon outdoes the network, neither is made larger.
    resume : continue from the checkpoint in ``folder``, under the plan it was written with and with
        the network it had, whatever that started from. For a plan in steps the result equals that
        of a run never interrupted; one on a budget keeps the number of steps it was aiming at.
    """
    started = time.perf_counter()
    checkpoint = Path(folder) / CHECKPOINT
    saved = read_checkpoint(checkpoint, scene.fingerprint, scene.name) if resume else None
    origin = start_record(start) if start is not None else {}
    if saved:
        plan, architecture, origin = saved.plan, saved.architecture or architecture, saved.start
        start = None  # its network is in the checkpoint
    spent = saved.seconds if saved else 0.0
    timed = budget is not None and not saved and plan.residual
    latest = started + _FEM_SHARE * budget if timed and budget is not None else np.inf
    problem = prepare(scene, plan, architecture, start=start, deadline=latest, progress=progress)
    weights, first = problem.emulator.weights, 0
    state = problem.optimiser.init(weights)
    if plan.runs:
        plan = replace(plan, simulations=len(problem.runs.theta) - 1)
    deadline, most = None, plan.steps if plan.residual else np.iinfo(np.int64).max
    if saved:
        weights, state = saved.restore(weights, state)
        first = saved.step
    elif budget is not None and plan.steps:
        share = _NETWORK_SHARE if plan.residual else 0.99
        deadline = started + share * budget
        fitting = _steps_within(deadline - time.perf_counter(), problem, plan)
        plan = replace(plan, steps=min(fitting, most))

    loss = saved.loss if saved else float("nan")

    def keep(weights: Weights, state: Any, done: int) -> None:
        seconds = spent + time.perf_counter() - started
        sizes, at = problem.emulator.architecture, (weights, state, done)
        write_checkpoint(checkpoint, scene.fingerprint, plan, sizes, origin, at, seconds, loss)

    if not saved:
        keep(weights, state, 0)
    bar = tqdm(desc="train", initial=first, total=plan.steps, disable=not progress)
    done, began = first, time.perf_counter()
    kept: tuple[jax.Array, ...] = ()
    while done < plan.steps:
        if plan.decoder == "separable" and done >= plan.freeze and not kept:
            kept = (jax.jit(lambda w: problem.emulator.prepared(w)[1])(weights),)
            began, first = time.perf_counter(), done
        arguments = (jnp.asarray(done), jnp.asarray(plan.steps), *kept)
        weights, state, value = problem.step(weights, state, *arguments)
        done += 1
        bar.update()
        if done % 50 == 0 or done == plan.steps:
            loss = float(value)
            bar.set_postfix(loss=f"{loss:.3e}")
        if deadline is not None and done % 200 == 0 and done > first:
            # The machine may have become busier, or less so: aim again at the deadline.
            now = time.perf_counter()
            left = int((deadline - now) / ((now - began) / (done - first)))
            plan = replace(plan, steps=min(done + max(left, 0), most))
            bar.total = plan.steps
        if done % plan.checkpoint_every == 0 and done < plan.steps:
            keep(weights, state, done)
    bar.close()
    if plan.steps and not np.isfinite(loss):
        raise SolverError("training ended in a loss that is not finite; lower the learning rate")
    record: dict[str, Any] = {"plan": asdict(plan), "final_loss": loss}
    if origin:
        record["start"] = origin
    emulator = replace(problem.emulator, weights=weights)
    if plan.residual:
        keep(weights, state, done)
        bases = BASES if plan.steps else BASES[:-1]
        emulator, record["residual"] = add_residual(emulator, problem.runs, bases)
    record["seconds"] = round(spent + time.perf_counter() - started, 1)
    return replace(emulator, record=record)


def remove_checkpoint(folder: str | Path) -> None:
    """Remove the checkpoint in ``folder``, if there is one."""
    (Path(folder) / CHECKPOINT).unlink(missing_ok=True)


def _steps_within(seconds: float, problem: Problem, plan: Plan) -> int:
    """How many steps fit into ``seconds``, from a few of them; their effect is thrown away."""
    started = time.perf_counter()
    one = _seconds_a_step(problem, plan)
    late = one
    if plan.decoder == "separable":
        weights = problem.emulator.weights
        late = _seconds_a_step(problem, plan, problem.emulator.prepared(weights)[1])
    left = 0.98 * seconds - (time.perf_counter() - started)
    early = min(left / one, plan.freeze) if late < one else left / one
    steps = int(early + max(left - early * one, 0.0) / late)
    if steps < WARMUP:
        raise InputError(
            f"the budget leaves {max(steps, 0)} training steps of {1e3 * one:.0f} ms after FEM "
            f"runs and compilation; give at least {WARMUP * one - left:.0f} s more"
        )
    return steps


def _seconds_a_step(problem: Problem, plan: Plan, *kept: jax.Array) -> float:
    weights = jax.tree.map(jnp.copy, problem.emulator.weights)  # a step consumes its arguments
    state = problem.optimiser.init(weights)
    durations = []
    for number in range(8):
        begin = time.perf_counter()
        arguments = (jnp.asarray(number), jnp.asarray(plan.steps), *kept)
        weights, state, value = problem.step(weights, state, *arguments)
        value.block_until_ready()
        durations.append(time.perf_counter() - begin)
    return float(np.median(durations[1:]))
