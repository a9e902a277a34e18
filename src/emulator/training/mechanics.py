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
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene, all_nodes
from emulator.surrogates.discrepancy import fit_discrepancy
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.taylor import Expansion, constant, expand
from emulator.training.job import FEM_SHARE, FEWEST, Job, Recipe
from emulator.training.plan import Plan, check_order, check_runs

_HELD_OUT = 5  # every fifth run is held out
_OBSERVATIONS = 4000  # values and derivatives; their covariance matrix takes 128 MB


@dataclass(frozen=True)
class Mechanics(Plan):
    """A Taylor series and a discrepancy model.

    simulations : the number of FEM runs, with their sensitivities.
    order : the order of the series; 0 is the FEM solution at the centre of the box.
    """

    recipe: str = "mechanics"
    simulations: int = 60
    order: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        check_runs(self.simulations)
        check_order(self.order)


def train_mechanics(plan: Mechanics, job: Job) -> Emulator:
    """Return the emulator and its record."""
    emulator, runs, series = prepare(plan, job)
    plan = replace(plan, simulations=len(runs.theta) - 1)
    emulator, choice = add_discrepancy(emulator, runs, series)
    return replace(emulator, record={**plan.record(), "discrepancy": choice})


def prepare(plan: Mechanics, job: Job) -> tuple[Emulator, Runs, Expansion]:
    """Return the emulator without its discrepancy model, the FEM runs, and FEM's series.

    The series is rounded as a file stores it: the discrepancy model is fitted to the one that is
    loaded.
    """
    scene, start = job.scene, job.start
    if start is not None and start.family is None:
        raise InputError(
            f"recipe '{plan.recipe}' begins from the network of a family of bodies; the "
            f"emulator of '{start.scene.name}' has none"
        )
    network = None if start is None else family_on(scene, start)
    series = expand(job.simulator, order=plan.order).rounded() if plan.order else None
    if series is not None:
        job.require_time("the series about the centre of the box")
    runs = job.fem_runs(plan, series, job.deadline(FEM_SHARE))
    job.require_time(f"{len(runs.theta)} FEM runs")
    if series is None:
        series = constant(np.asarray(scene.to_unit(scene.centre)), runs.displacement[0])
    if network is None:
        return Emulator(scene, taylor=series), runs, series
    return anchored(network, series), runs, series


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


MECHANICS = Recipe(Mechanics(), train_mechanics)
