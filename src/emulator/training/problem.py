"""What a training works on: FEM runs, and an emulator whose network is untrained."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Predictor, Runs, StoredRuns, run_campaign
from emulator.fem.campaign.designs import design, sobol
from emulator.scenes.scene import Scene, all_nodes
from emulator.surrogates.additive import Emulator
from emulator.surrogates.network.family import FamilyNetwork
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import Expansion, constant, expand
from emulator.training.budget import Budget
from emulator.training.discrepancy_stage import FEWEST
from emulator.training.network import NetworkTraining, network_training, scales_of, untrained
from emulator.training.plan import Plan
from emulator.training.start import architecture_from, family_on, on_finer, with_network_of
from emulator.training.sweeps import part_of, runs_of, sweep_box


@dataclass(frozen=True, eq=False)
class Problem:
    """What a training works on.

    plan : with as many simulations as were run.
    emulator : untrained; without a network where the plan has no optimiser step.
    runs : FEM solutions, or what sweeps say in their place, the centre's first; None where nothing
        is taught by any.
    training : of the network; None without one.
    series : FEM's own, where the emulator's is of what a family's network leaves or on a coarser
        mesh.
    record : what an emulator's record tells besides, of sweeps in place of FEM.
    """

    plan: Plan
    emulator: Emulator
    runs: Runs | None
    training: NetworkTraining | None = None
    series: Expansion | None = None
    record: Mapping[str, Any] = field(default_factory=dict)

    @property
    def architecture(self) -> Architecture | None:
        """Sizes of the network; None without one."""
        return None if self.training is None else self.training.network.architecture


def prepare(
    scene: Scene,
    plan: Plan,
    architecture: Architecture | None = None,
    *,
    start: Emulator | None = None,
    campaign: StoredRuns | None = None,
    folder: Path | None = None,
    budget: Budget | None = None,
    progress: bool = False,
) -> Problem:
    """Run the FEM solutions a plan needs and set up its emulator; equal for equal inputs.

    Parameters
    ----------
    start : the emulator whose network to begin from, on any mesh; its architecture then is the
        default. Of a plan on a coarser mesh, and of sweeps, the emulator there.
    campaign : FEM runs that are there already; the centre's alone is then solved.
    folder : where sweeps are kept, and taken up again.
    budget : ends FEM runs in time, except the fewest that a discrepancy model can be judged by.

    Raises
    ------
    InputError
        The budget is over before training begins.
    """
    deadline = np.inf if budget is None else budget.fem_deadline(plan)
    if plan.on_coarse:
        carried = on_finer(start, scene, plan)
        assert start is not None, "checked by on_finer"
        before = _by_position(carried)
        runs = _runs(Simulator(scene), plan, before, campaign, deadline, progress)
        plan = replace(plan, simulations=len(runs.theta) - 1)
        return Problem(plan, carried, runs, series=start.taylor)
    family = below = None
    if start is not None and start.family is not None:
        family = family_on(start, scene, plan)
    elif start is not None and plan.sweeps and not plan.steps:
        below = on_finer(start, scene, plan)
    elif start is not None:
        architecture = architecture_from(start, scene, plan, architecture)
    simulator, record = Simulator(scene), dict[str, Any]()
    if plan.sweeps:
        swept = sweep_box(
            simulator,
            plan.sweeps,
            plan.seed,
            start=_beginning(simulator, plan, family),
            beneath=None if below is None else _by_position(below),
            folder=folder,
            deadline=deadline,
            progress=progress,
        )
        plan, series = replace(plan, sweeps=swept.number), None
        record["sweeps"] = swept.record
        if not plan.steps:
            found = below or Emulator(scene)
            found = replace(found, polynomial=part_of(simulator, swept))
            return Problem(plan, found, None, record=record)
        taught = design(scene, plan.simulations, plan.seed)
        runs = runs_of(simulator, swept, jnp.concatenate([scene.centre[None], taught]))
    else:
        # Rounded as a file stores it: the discrepancy is fitted to the series that is loaded.
        series = expand(simulator, order=plan.order).rounded() if plan.order else None
        if budget is not None and series is not None:
            budget.require("the series about the centre of the box")
        runs = _runs(simulator, plan, series, campaign, deadline, progress)
    if budget is not None:
        budget.require(f"{plan.sweeps} sweeps" if plan.sweeps else f"{len(runs.theta)} FEM runs")
    if plan.runs:
        plan = replace(plan, simulations=len(runs.theta) - 1)
    if series is None and plan.centred:
        series = constant(np.asarray(scene.to_unit(scene.centre)), runs.displacement[0])
    if family is not None:
        assert series is not None, "its recipes have a series"
        rest = series.less(family.cache(all_nodes(scene))).rounded()
        return Problem(plan, Emulator(scene, taylor=rest, family=family), runs, series=series)
    emulator = Emulator(scene, taylor=series)
    if not plan.steps:
        return Problem(plan, emulator, runs)
    if plan.objective == "modes" and plan.freeze >= plan.steps:
        plan = replace(plan, freeze=plan.steps // 2)
    scale, scales = scales_of(scene, plan, runs)
    network = untrained(simulator, plan, architecture, series, scale)
    emulator = replace(emulator, network=network)
    if start is not None:
        emulator = with_network_of(emulator, start)
    training = network_training(emulator, plan, runs, scales)
    return Problem(plan, emulator, runs, training, record=record)


def _beginning(
    simulator: Simulator, plan: Plan, family: FamilyNetwork | None
) -> Callable[[jax.Array], jax.Array] | None:
    """Where sweeps begin under the whole load, by position in the box; None at rest."""
    if family is not None:
        return _by_position(Emulator(simulator.scene, family=family))
    return expand(simulator, order=plan.order) if plan.order else None


def _by_position(emulator: Emulator) -> Callable[[jax.Array], jax.Array]:
    """``emulator`` of the position in the unit box."""
    cached = emulator.cache()
    return lambda position: cached(emulator.scene.from_unit(position))


def _runs(
    simulator: Simulator,
    plan: Plan,
    series: Predictor | None,
    campaign: StoredRuns | None,
    deadline: float,
    progress: bool,
) -> Runs:
    """The FEM solutions of a plan, the centre's first; the others may be a campaign's."""
    scene = simulator.scene
    thetas = scene.centre[None]
    if campaign is not None:
        known = _taken(plan, campaign)
    elif plan.runs:
        draw = design if plan.slopes else sobol
        thetas = jnp.concatenate([thetas, draw(scene, plan.runs, plan.seed)])
    runs = run_campaign(
        simulator,
        thetas,
        sensitivities=plan.slopes,
        predictor=series,
        deadline=deadline,
        at_least=FEWEST + 1,
        progress=progress,
    )
    return runs if campaign is None else runs.followed_by(known)


def _taken(plan: Plan, campaign: StoredRuns) -> Runs:
    """The runs of a campaign that a plan needs."""
    there = len(campaign.runs.theta)
    if plan.runs > there:
        raise InputError(
            f"training: {plan.runs} simulations of a campaign with {there} that converged"
        )
    if plan.slopes and campaign.runs.sensitivities is None:
        raise InputError(
            f"training: recipe '{plan.recipe}' needs slopes, which the campaign lacks; make one "
            "with --slopes"
        )
    return campaign.runs.take(slice(plan.runs))
