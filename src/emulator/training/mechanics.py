"""Recipe ``mechanics``: a Taylor series of the equilibrium, and a discrepancy model of FEM runs.

There is no network; from a mesh to an emulator takes a minute. On a body of a family that a network
has learned, the series expands the remainder of the network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.accuracy.comparison import evaluate
from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene, all_nodes
from emulator.surrogates.discrepancy import fit_discrepancy
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import Expansion, constant, expand
from emulator.training.checkpoint import Record, Session
from emulator.training.plan import FEWEST, Job, Plan, check_order, check_runs

_HELD_OUT = 5  # every fifth run is held out
_OBSERVATIONS = 4000  # values and derivatives; their covariance matrix takes 128 MB
FEM_SHARE = 0.3
"""The share of a budget after which no FEM run begins."""


@dataclass(frozen=True)
class DiscrepancyPlan(Plan):
    """The options of recipes that fit a discrepancy model and train no network.

    simulations : the number of FEM runs on the scene's own mesh, with their sensitivities.
    """

    simulations: int = 60

    def __post_init__(self) -> None:
        super().__post_init__()
        check_runs(self.simulations)

    def prepare(self, job: Job) -> tuple[Emulator, Runs, Expansion | None]:
        """Return the emulator without its discrepancy model, the FEM runs, and FEM's series."""
        raise NotImplementedError

    def train(self, job: Job, session: Session) -> tuple[Emulator, Record]:
        """Return the emulator and its record."""
        emulator, runs, series = self.prepare(job)
        plan = self.with_counts(simulations=len(runs.theta) - 1)
        session.write_plan(plan)
        emulator, choice = add_discrepancy(emulator, runs, series)
        return emulator, {**plan.record(), "discrepancy": choice}


@dataclass(frozen=True)
class Mechanics(DiscrepancyPlan):
    """A Taylor series and a discrepancy model.

    order : the order of the series; 0 is the FEM solution at the centre of the box.
    """

    recipe: str = "mechanics"
    order: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self.order)

    def prepare(self, job: Job) -> tuple[Emulator, Runs, Expansion]:
        """Return the emulator without its discrepancy model, the FEM runs, and FEM's series."""
        scene, start = job.scene, job.start
        if start is not None and start.family is None:
            raise InputError(
                f"recipe '{self.recipe}' begins from the network of a family of bodies; the "
                f"emulator of '{start.scene.name}' has none"
            )
        network = None if start is None else family_on(scene, start)
        series, runs = _series_and_runs(job, self)
        if network is None:
            return Emulator(scene, taylor=series), runs, series
        return anchored(network, series), runs, series


def _series_and_runs(job: Job, plan: Mechanics) -> tuple[Expansion, Runs]:
    """Return the series about the centre of the box, rounded as a file stores it, and FEM runs.

    The discrepancy model is fitted to the series that is loaded from a file.
    """
    simulator = Simulator(job.scene)
    series = expand(simulator, order=plan.order).rounded() if plan.order else None
    if series is not None:
        job.require_time("the series about the centre of the box")
    runs = job.fem_runs(simulator, plan, series, job.deadline(FEM_SHARE))
    job.require_time(f"{len(runs.theta)} FEM runs")
    if series is None:
        series = constant(np.asarray(job.scene.to_unit(job.scene.centre)), runs.displacement[0])
    return series, runs


def add_discrepancy(
    emulator: Emulator, runs: Runs, series: Expansion | None = None
) -> tuple[Emulator, dict[str, Any]]:
    """Return ``emulator`` with a discrepancy model of ``runs``, and a record of its choice.

    The model is fitted on top of nothing, of the Taylor series, and of a family's network with what
    the series adds, and the sum with the least error at held-out runs is taken, then fitted to all
    runs. Parts that are not in that sum are dropped.

    emulator : the emulator without a discrepancy model.
    runs : FEM runs with sensitivities.
    series : the series of FEM, where that in ``emulator`` is of what a family's network leaves.

    Raises :class:`InputError`: no run besides the centre's.
    """
    most = _OBSERVATIONS // (1 + runs.theta.shape[1])
    runs = runs.take(slice(0, most))
    count = len(runs.theta)
    if count < 2:
        raise InputError(
            "the discrepancy model needs FEM runs besides the centre's; give a larger budget"
        )
    series = (
        series
        or emulator.taylor
        or constant(np.full(runs.theta.shape[1], 0.5), jnp.zeros(emulator.scene.held.shape))
    )

    def fitted(bare: Emulator, some: Runs) -> Emulator:
        mean = of_position(bare) if bare.parts else None
        return replace(bare, discrepancy=fit_discrepancy(bare.scene, some, series, mean).rounded())

    sums = _sums(emulator, series)
    errors: dict[str, float] = {}
    trials: dict[str, Emulator] = {}
    record: dict[str, Any] = {}
    best = next((n for n in ("coarse", "taylor") if n in sums), "nothing")
    if count >= FEWEST:
        test = np.arange(count) % _HELD_OUT == _HELD_OUT - 1
        for name, bare in sums.items():
            trials[name] = fitted(bare, runs.take(~test))
            errors[name] = _error(trials[name], runs.take(test))
        best = min(errors, key=errors.__getitem__)
        record["held_out"] = evaluate(trials[best].cache(), *runs.take(test)[:2])
    final_model = fitted(sums[best], runs)
    assert final_model.discrepancy is not None, "it was fitted above"
    modes = len(final_model.discrepancy.modes)
    record |= {"on": best, "runs": count, "modes": modes, "held_out_err_u_mm": errors}
    return final_model, record


def _sums(emulator: Emulator, series: Expansion) -> dict[str, Emulator]:
    """Return the sums of parts to which a discrepancy model may be added, by name."""
    bare = replace(emulator, discrepancy=None)
    nothing = replace(bare, taylor=None, family=None)
    if emulator.coarse is not None:  # the coarse emulator has learned from many runs of this body
        candidates = [bare]
    elif emulator.family is not None:
        series_only = replace(bare, taylor=None)
        candidates = [nothing, replace(nothing, taylor=series), series_only, bare]
    else:
        candidates = [nothing, bare]
    return {" + ".join(sum_.parts) or "nothing": sum_ for sum_ in candidates}


def family_on(scene: Scene, start: Emulator) -> Emulator:
    """Return the network of a family in ``start``, alone, on ``scene``."""
    assert start.family is not None, "the start has a family's network"
    return Emulator(scene, family=start.family.on(scene))


def anchored(network: Emulator, series: Expansion) -> Emulator:
    """Return the network of a family made to have the derivatives of ``series`` at its centre."""
    assert network.family is not None, "the network is of a family"
    family_map = network.family.cache(all_nodes(network.scene))
    return replace(network, taylor=series.less(family_map).rounded())


def of_position(emulator: Emulator) -> Callable[[jax.Array], jax.Array]:
    """Return the cached ``emulator`` as a function of the position in the unit box."""
    cached = emulator.cache()
    return lambda position: cached(emulator.scene.from_unit(position))


def _error(emulator: Emulator, runs: Runs) -> float:
    """Return the geometric mean of err_u over ``runs``, mm, so that no single error decides."""
    predicted = jax.jit(emulator.cache())(runs.theta)
    errors = jnp.mean(jnp.linalg.norm(predicted - runs.displacement, axis=-1), axis=-1)
    return float(jnp.exp(jnp.mean(jnp.log(errors + 1e-300))))
