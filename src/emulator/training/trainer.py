"""Training an emulator of one scene, resumable at any moment."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from emulator.catalogue import finer_of
from emulator.errors import InputError
from emulator.fem.campaign import StoredRuns
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.files import load, save_emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.aim import Aim
from emulator.training.budget import Budget
from emulator.training.checkpoint import CHECKPOINT, Checkpoint, State, Writer, read_checkpoint
from emulator.training.discrepancy_stage import add_discrepancy
from emulator.training.loop import Bar, Hook, Keep, Steps, optimise, require_finite
from emulator.training.plan import Plan, recipe
from emulator.training.problem import Problem, prepare
from emulator.training.start import family_on, start_record, with_weights


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
    folder : where checkpoints go. The finished emulator is returned, not written; remove the last
        checkpoint with :func:`remove_checkpoint` once it is safe.
    start : begin from the network of this emulator, which may be of another geometry; of recipe
        two_meshes, the emulator on the coarser mesh, made by recipe mechanics if none is given.
    campaign : FEM runs to take the first ``plan.simulations`` of, instead of making them; needed
        again to resume.
    budget : seconds for everything (FEM runs, compilation, training, the discrepancy model). It
        replaces ``plan.steps`` by as many as fit, estimated again as the machine gets busier or
        less so, and ``plan.simulations`` by as many as were done in its first third. Where a
        discrepancy model follows, which soon outdoes the network, neither is made larger.
    resume : continue from the checkpoint in ``folder``, under the plan it was written with and with
        the network it holds. For a plan in steps the result equals that of a run never
        interrupted; one on a budget keeps the number of steps it was aiming at.
    """
    if campaign is not None and not (plan.runs or resume):
        raise InputError(f"training: recipe '{plan.recipe}' takes no FEM runs, so no campaign")
    path, began = Path(folder) / CHECKPOINT, time.perf_counter()
    if plan.as_learned:
        return _as_learned(scene, plan, start, began)
    saved = read_checkpoint(path, scene.fingerprint, scene.name) if resume else None
    if plan.on_coarse and start is None:
        start = _coarse(scene, Path(folder) / "coarse", progress=progress, resume=resume)
    source = {} if start is None else start_record(start)
    plan = replace(plan, campaign="" if campaign is None else campaign.digest)
    if saved is not None:
        _check_campaign(saved.plan, plan)
        plan, architecture, source = saved.plan, saved.architecture or architecture, saved.start
        budget = None  # it is in the checkpoint, and so is a network to start from
        start = start if plan.on_coarse else None
    limit = None if budget is None else Budget(budget, began)
    problem = prepare(
        scene,
        plan,
        architecture,
        start=start,
        campaign=campaign,
        budget=limit,
        progress=progress,
    )
    writer = Writer(path, scene.fingerprint, problem.architecture, source)
    spent = saved.seconds if saved is not None else 0.0
    clock = lambda: spent + time.perf_counter() - began  # noqa: E731
    state = _optimise(problem, saved, limit, Keep(writer, problem.plan, clock), progress)
    emulator, record = _finish(problem, state, progress=progress)
    record |= {"start": source} if source else {}
    return replace(emulator, record={**record, "seconds": round(clock(), 1)})


def _coarse(scene: Scene, folder: Path, *, progress: bool, resume: bool) -> Emulator:
    """An emulator on the mesh that the scene's is finer than, kept in ``folder``."""
    coarse = finer_of(scene).coarse
    if resume and (folder / "emulator.json").is_file():
        return load(folder, coarse)
    found = train(coarse, recipe("mechanics"), folder, progress=progress)
    save_emulator(found, folder)
    remove_checkpoint(folder)
    return found


def _check_campaign(saved: Plan, given: Plan) -> None:
    """Refuse to resume with other FEM runs."""
    if saved.campaign != given.campaign:
        what = "FEM runs of a campaign" if saved.campaign else "FEM runs of its own"
        raise InputError(f"the checkpoint was trained on {what}; resume it with the same")


def _as_learned(scene: Scene, plan: Plan, start: Emulator | None, began: float) -> Emulator:
    """The network of a family on ``scene``, as it is."""
    if start is None or start.family is None:
        raise InputError(
            "recipe 'family' takes a network that has learned a family of bodies to a new one; "
            "give it as the start, e.g. ventricle_family"
        )
    part = family_on(start, scene, plan)
    record = {
        "plan": asdict(plan),
        "final_loss": None,
        "start": start_record(start),
        "seconds": round(time.perf_counter() - began, 1),
    }
    return Emulator(scene, family=part, record=record)


def _optimise(
    problem: Problem, saved: Checkpoint | None, limit: Budget | None, keep: Keep, progress: bool
) -> State:
    """The state after all steps."""
    plan, hooks = problem.plan, list[Hook]()
    state, total = State(*problem.initial()), plan.steps
    if saved is not None:
        state = saved.restore(*state[:2])
    elif limit is not None and total:
        aim = Aim(limit.network_deadline(plan), plan)
        total = aim.first_total(problem)
        hooks.append(aim)
    if saved is None:
        keep.write(state, total)
    with Bar("train", state, total, shown=progress) as bar:
        return optimise(state, total, Steps([problem]), [*hooks, bar, keep])


def _finish(problem: Problem, state: State, *, progress: bool) -> tuple[Emulator, dict[str, Any]]:
    """The trained emulator with its discrepancy model, if the plan has one, and the record."""
    plan, emulator, loss = replace(problem.plan, steps=state.done), problem.emulator, None
    if emulator.network is not None:
        loss = require_finite(state)
        emulator = with_weights(emulator, problem.finish(state.weights, progress=progress))
    record: dict[str, Any] = {"plan": asdict(plan), "final_loss": loss}
    if plan.discrepancy:
        emulator, record["discrepancy"] = add_discrepancy(emulator, problem.runs, problem.series)
    return emulator, record


def remove_checkpoint(folder: str | Path) -> None:
    """Remove the checkpoint in ``folder``, if there is one."""
    (Path(folder) / CHECKPOINT).unlink(missing_ok=True)
