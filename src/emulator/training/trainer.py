"""Training an emulator of one scene, resumable at any moment."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from emulator.catalogue import finer_of
from emulator.core.errors import InputError
from emulator.fem.campaign import StoredRuns
from emulator.fem.energy import require_rest
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.files import load, save_emulator
from emulator.surrogates.network.pignn import Architecture
from emulator.training.aim import Aim
from emulator.training.budget import Budget
from emulator.training.checkpoint import (
    SWEEPS,
    Session,
    State,
    open_session,
    remove_checkpoint,
)
from emulator.training.discrepancy_stage import add_discrepancy
from emulator.training.loop import Hook, Steps, require_finite, run
from emulator.training.plan import Plan, recipe
from emulator.training.problem import Problem, prepare
from emulator.training.start import family_on, start_record, with_weights
from emulator.training.sweeps import check_sweeps


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
    resume : continue from the checkpoint in ``folder``, among sweeps or steps, under the plan it
        was written with and with the network it holds; where no network is trained, ``start`` is
        needed again. For a plan in steps the result equals that of a run never interrupted; one on
        a budget keeps the number of steps it was aiming at, and killed among its sweeps goes on
        without the budget.
    """
    if campaign is not None and not (plan.runs or resume):
        raise InputError(f"training: recipe '{plan.recipe}' takes no FEM runs, so no campaign")
    if plan.steps:
        require_rest(scene)  # networks learn from the energy there, or have its modes
    if plan.as_learned:
        return _as_learned(scene, plan, start)
    session = open_session(folder, scene.fingerprint, scene.name, plan, architecture, resume=resume)
    if session.plan.on_coarse and start is None:
        start = _coarse(scene, Path(folder) / "coarse", known=resume, progress=progress)
    source = {} if start is None else start_record(start)
    digest = "" if campaign is None else campaign.digest
    if resume:
        _check_same(session, digest, source)
        budget = None  # it is in the checkpoint
    else:
        session = replace(session, plan=replace(plan, campaign=digest), start=source)
        (Path(folder) / SWEEPS).unlink(missing_ok=True)
        if plan.sweeps:
            check_sweeps(scene, plan.sweeps, at_rest=not plan.order and start is None)
            session.announce()
    limit = None if budget is None else Budget(budget, session.began)
    problem = prepare(
        scene,
        session.plan,
        session.architecture,
        start=start,
        campaign=campaign,
        folder=Path(folder),
        budget=limit,
        progress=progress,
    )
    session = replace(session, plan=problem.plan, architecture=problem.architecture)
    state = _optimise(problem, session, limit, progress)
    emulator, record = _finish(problem, state, progress=progress)
    record |= {"start": session.start} if session.start else {}
    return replace(emulator, record={**record, "seconds": round(session.seconds, 1)})


def _coarse(scene: Scene, folder: Path, *, known: bool, progress: bool) -> Emulator:
    """An emulator on the mesh that the scene's is finer than, kept in ``folder``."""
    coarse = finer_of(scene).coarse
    if known:
        return load(folder, coarse)
    found = train(coarse, recipe("mechanics"), folder, progress=progress)
    save_emulator(found, folder)
    remove_checkpoint(folder)
    return found


def _check_same(session: Session, digest: str, start: Mapping[str, Any]) -> None:
    """Refuse to resume with other FEM runs, or on another emulator."""
    if session.plan.campaign != digest:
        what = "FEM runs of a campaign" if session.plan.campaign else "FEM runs of its own"
        raise InputError(f"the checkpoint was trained on {what}; resume it with the same")
    if session.plan.steps and start:
        raise InputError("the checkpoint has its network's weights; resume it without a start")
    if not session.plan.steps and session.start != start:
        raise InputError(
            "the checkpoint stands on another emulator than is given as the start; resume it with "
            "the same"
        )


def _as_learned(scene: Scene, plan: Plan, start: Emulator | None) -> Emulator:
    """The network of a family on ``scene``, as it is."""
    began = time.perf_counter()
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


def _optimise(problem: Problem, session: Session, limit: Budget | None, progress: bool) -> State:
    """The state after all steps."""
    training, plan = problem.training, problem.plan
    if training is None:
        return session.first(State({}, ()), 0)
    hooks, total = list[Hook](), plan.steps
    if limit is not None:
        aim = Aim(limit.network_deadline(plan), plan)
        total = aim.first_total(training)
        hooks.append(aim)
    state = State(*training.initial())
    return run(session, state, total, Steps([training]), hooks, progress=progress)


def _finish(problem: Problem, state: State, *, progress: bool) -> tuple[Emulator, dict[str, Any]]:
    """The trained emulator with its discrepancy model, if the plan has one, and the record."""
    plan, emulator, loss = replace(problem.plan, steps=state.done), problem.emulator, None
    if problem.training is not None:
        loss = require_finite(state)
        emulator = with_weights(emulator, problem.training.finish(state.weights, progress=progress))
    record: dict[str, Any] = {"plan": asdict(plan), "final_loss": loss}
    record |= problem.record
    if plan.discrepancy:
        assert problem.runs is not None, "a discrepancy model is fitted to them"
        emulator, record["discrepancy"] = add_discrepancy(emulator, problem.runs, problem.series)
    return emulator, record
