"""What a training works on: FEM runs, an untrained emulator, and one optimiser step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from emulator.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Runs, StoredRuns, run_campaign
from emulator.fem.campaign.designs import design, sobol
from emulator.fem.campaign.starts import Predictor
from emulator.scenes.nodes import all_nodes
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.network.graph import augment
from emulator.surrogates.network.part import Network, fresh
from emulator.surrogates.network.pignn import Architecture
from emulator.surrogates.taylor import Expansion, constant, expand
from emulator.training.basis import mechanical_modes
from emulator.training.budget import Budget
from emulator.training.discrepancy_stage import FEWEST
from emulator.training.modal import ARCHITECTURE, Modal
from emulator.training.objectives import Scales, make_loss, mean_square_gradient
from emulator.training.plan import Plan
from emulator.training.start import architecture_from, family_on, on_finer, with_network_of
from emulator.training.step import Step, batch_descent, clipped_adam, make_step

# Standard deviation of the displacements as a fraction of the centre's, where no FEM run tells it.
_GUESSED_SD = 0.2


@dataclass(frozen=True, eq=False)
class Problem:
    """What a training works on.

    plan : with as many simulations as were run.
    emulator : untrained; without a network where the plan has no optimiser step.
    runs : FEM solutions, the centre's first.
    optimiser, step : of the network (:func:`~emulator.training.step.make_step`), or None.
    modal : what teaches the network modes and then coefficients, for plans that do.
    series : FEM's own, where the emulator's is of what a family's network leaves or on a coarser
        mesh.
    """

    plan: Plan
    emulator: Emulator
    runs: Runs
    optimiser: optax.GradientTransformation | None
    step: Step | None
    modal: Modal | None = None
    series: Expansion | None = None

    @property
    def architecture(self) -> Architecture | None:
        """Sizes of the network; None without one."""
        network = self.emulator.network
        return None if network is None else network.architecture

    def keep(self, weights: Any) -> tuple[jax.Array, ...]:
        """What steps after ``plan.freeze`` of a separable decoder take from ``weights``."""
        network = self.emulator.network
        assert network is not None, "only a network has steps"
        if self.modal is not None:
            return tuple(self.modal.keep(weights))
        return (jax.jit(lambda w: network.prepare(w)[1])(weights),)

    def finish(self, weights: Any, *, progress: bool = False) -> Any:
        """The trained weights, from those after the last step."""
        if self.modal is None:
            return weights
        return self.modal.finish(weights, self.plan.polish, progress=progress)

    def initial(self) -> tuple[Any, Any]:
        """Copies of the untrained weights, and the optimiser's state; empty without a network."""
        if self.emulator.network is None or self.optimiser is None:
            return {}, ()
        weights = jax.tree.map(jnp.copy, self.emulator.network.weights)
        return weights, self.optimiser.init(weights)


def prepare(
    scene: Scene,
    plan: Plan,
    architecture: Architecture | None = None,
    *,
    start: Emulator | None = None,
    campaign: StoredRuns | None = None,
    budget: Budget | None = None,
    progress: bool = False,
) -> Problem:
    """Run the FEM solutions a plan needs and set up its emulator; equal for equal inputs.

    Parameters
    ----------
    start : the emulator whose network to begin from, on any mesh; its architecture then is the
        default. Of a plan on a coarser mesh, the emulator there.
    campaign : FEM runs that are there already; the centre's alone is then solved.
    budget : ends FEM runs in time, except the fewest that a discrepancy model can be judged by.

    Raises
    ------
    InputError
        The budget is over before training begins.
    """
    deadline = np.inf if budget is None else budget.fem_deadline(plan)
    if plan.on_coarse:
        return _on_coarse(scene, plan, start, campaign, deadline, progress)
    family = None
    if start is not None and start.family is not None:
        family = family_on(start, scene, plan)
    elif start is not None:
        architecture = architecture_from(start, scene, plan, architecture)
    simulator = Simulator(scene)
    # Rounded as a file stores it, so that the discrepancy is fitted to the series that is loaded.
    series = expand(simulator, order=plan.order).rounded() if plan.order else None
    if budget is not None and series is not None:
        budget.require("the series about the centre of the box")
    if campaign is None:
        runs = _run(simulator, plan, series, deadline, progress)
    else:
        runs = _taken(simulator, plan, series, campaign)
    if budget is not None:
        budget.require(f"{len(runs.theta)} FEM runs")
    if plan.runs:
        plan = replace(plan, simulations=len(runs.theta) - 1)
    if series is None and plan.centred:
        series = constant(np.asarray(scene.to_unit(scene.centre)), runs.displacement[0])
    if family is not None:
        assert series is not None, "its recipes have a series"
        rest = series.less(family.cache(all_nodes(scene))).rounded()
        emulator = Emulator(scene, taylor=rest, family=family)
        return Problem(plan, emulator, runs, None, None, series=series)
    emulator = Emulator(scene, taylor=series)
    if plan.objective == "modes" and plan.freeze >= plan.steps:
        plan = replace(plan, freeze=plan.steps // 2)
    if not plan.steps:
        return Problem(plan, emulator, runs, None, None)
    scale, scales = _scales(scene, plan, runs)
    sizes = architecture or (ARCHITECTURE if plan.objective == "modes" else Architecture())
    network = _network(simulator, plan, sizes, series, scale)
    emulator = replace(emulator, network=network)
    if start is not None:
        emulator = with_network_of(emulator, start)
    optimiser = clipped_adam()
    if plan.objective == "modes":
        assert emulator.network is not None, "it was given one"
        modal = Modal(scene, emulator.network, runs, scales)
        step = make_step(plan, modal.descend, optimiser)
        return Problem(plan, emulator, runs, optimiser, step, modal)
    loss = make_loss(scene, plan.objective, scales, plan.energy_weight)
    step = make_step(plan, batch_descent(emulator, plan, runs, loss), optimiser)
    return Problem(plan, emulator, runs, optimiser, step)


def _on_coarse(
    scene: Scene,
    plan: Plan,
    start: Emulator | None,
    campaign: StoredRuns | None,
    deadline: float,
    progress: bool,
) -> Problem:
    """Runs on the scene's own mesh, and the emulator ``start`` on a coarser one."""
    emulator = on_finer(start, scene)
    cached, simulator = emulator.cache(), Simulator(scene)
    before = lambda position: cached(scene.from_unit(position))  # noqa: E731
    if campaign is None:
        runs = _run(simulator, plan, before, deadline, progress)
    else:
        runs = _taken(simulator, plan, before, campaign)
    plan = replace(plan, simulations=len(runs.theta) - 1)
    assert start is not None, "checked by on_finer"
    return Problem(plan, emulator, runs, None, None, series=start.taylor)


def _run(
    simulator: Simulator, plan: Plan, series: Predictor | None, deadline: float, progress: bool
) -> Runs:
    """The FEM solutions of a plan, the centre's first."""
    scene = simulator.scene
    thetas = scene.centre[None]
    if plan.runs:
        draw = design if plan.slopes else sobol
        thetas = jnp.concatenate([thetas, draw(scene, plan.runs, plan.seed)])
    return run_campaign(
        simulator,
        thetas,
        sensitivities=plan.slopes,
        predictor=series,
        deadline=deadline,
        at_least=FEWEST + 1,
        progress=progress,
    )


def _taken(
    simulator: Simulator, plan: Plan, series: Predictor | None, campaign: StoredRuns
) -> Runs:
    """The centre's solution, and those of a campaign that a plan needs."""
    scene, there = simulator.scene, len(campaign.runs.theta)
    if plan.runs > there:
        raise InputError(
            f"training: {plan.runs} simulations of a campaign with {there} that converged"
        )
    if plan.slopes and campaign.runs.sensitivities is None:
        raise InputError(
            f"training: recipe '{plan.recipe}' needs slopes, which the campaign lacks; make one "
            "with --slopes"
        )
    first = run_campaign(simulator, scene.centre[None], sensitivities=plan.slopes, predictor=series)
    return first.followed_by(campaign.runs.take(slice(plan.runs)))


def _network(
    simulator: Simulator,
    plan: Plan,
    architecture: Architecture,
    series: Expansion | None,
    scale: np.ndarray,
) -> Network:
    """An untrained network; a separable decoder is given the mechanical modes of the series."""
    architecture = replace(architecture, decoder=plan.decoder)
    basis = None
    if plan.decoder == "separable" and series is not None:
        basis = (mechanical_modes(simulator, series, plan.modes) / scale).astype(np.float32)
    scene = simulator.scene
    return fresh(scene, augment(scene), architecture, scale, plan.seed, basis)


def _scales(scene: Scene, plan: Plan, runs: Runs) -> tuple[np.ndarray, Scales]:
    """Scales of the network's output by component, (3,) mm, and of the loss.

    Root mean squares of the runs' deviations from the centre's solution.
    """
    centre = np.asarray(runs.displacement[0])
    known = len(runs.theta) > 1 and plan.objective != "energy"
    deviation = np.asarray(runs.displacement[1:]) - centre if known else _GUESSED_SD * centre[None]
    free = ~scene.held
    component = [float(np.sqrt(np.mean(deviation[:, free[:, k], k] ** 2))) for k in range(3)]
    scales = Scales(
        displacement=float(np.sqrt(np.mean(np.sum(deviation**2, axis=-1)))),
        gradient=float(jnp.sqrt(mean_square_gradient(scene, jnp.asarray(deviation)))),
        energy=float(jnp.abs(runs.energy[0])),
    )
    if plan.objective == "modes":  # their products are the same in all directions
        return np.full(3, scales.displacement), scales
    if not plan.centred:
        return np.full(3, np.sqrt(np.mean(centre**2))), scales
    return np.maximum(component, 1e-3 * max(component)), scales
