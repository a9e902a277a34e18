"""The rungs: every way from theta to displacements, in stages, each in a process of its own.

Times are processor seconds: the machine may be shared, and a process keeps to one core.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import jax
import numpy as np
from studies.accuracy_vs_time.bodies import NETWORK, Body
from studies.common.maps import shipped
from studies.common.timing import clocked
from studies.common.two_meshes import on_two_meshes

import calibrate as cal
import emulator as em

POINTS, SEED = 24, 4
FAST_CALLS = 60
COMPILED = 5000  # nodes below which Newton steps are compiled into one program with the map
Solve = Callable[[jax.Array], jax.Array]
CLOCK = process_time


@dataclass(frozen=True)
class Rung:
    """One way from theta (p,) to the displacements (k, 3) of the observed nodes, or of all.

    scene : whose mesh ``observed`` is of. calls : of each timing. offline_s, fem_runs : what had
    to be done before. compiled : whether a call is a compiled program. narrow : in float32. kind :
    for the figure.
    """

    name: str
    kind: str
    scene: em.Scene
    solve: Solve
    offline_s: float = 0.0
    fem_runs: int = 0
    compiled: bool = True
    full: bool = False
    narrow: bool = False
    calls: int = FAST_CALLS


@dataclass(frozen=True)
class Place:
    """A body, its scene, and how much of it is asked for."""

    name: str
    body: Body
    scene: em.Scene
    published: Any
    quick: bool

    @cached_property
    def simulator(self) -> em.Simulator:
        return em.Simulator(self.scene)

    @cached_property
    def at(self) -> np.ndarray:
        """The observed material points, (24, 3) mm."""
        return cal.spread_landmarks(self.scene, POINTS, SEED)

    def some(self, values: tuple) -> tuple:
        """The first of ``values`` where few are asked for."""
        return values[:1] if self.quick else values


def of_map(name: str, kind: str, forward: em.ForwardMap, at: np.ndarray, **more: Any) -> Rung:
    """A forward map decoded at the observed points' nodes."""
    return Rung(
        name, kind, forward.scene, forward.at(cal.landmarks(forward.scene, at).nodes), **more
    )


def of_fem(
    name: str, simulator: em.Simulator, place: Place, start: Solve | None = None, **more: Any
) -> Rung:
    """FEM called from Python, from rest or started by a compiled map of the whole field."""
    nodes, begin = cal.landmarks(simulator.scene, place.at).nodes, start and jax.jit(start)

    def solve(theta: jax.Array) -> jax.Array:
        first = None if begin is None else begin(jax.lax.stop_gradient(theta))
        return simulator.solve(theta, first).require_converged(name).displacement[nodes]

    calls = place.body.calls
    return Rung(name, "FEM", simulator.scene, solve, compiled=False, calls=calls, **more)


# ---- stages ----------------------------------------------------------------------------------
def from_rest(place: Place) -> Iterator[Rung]:
    """FEM from rest, by tolerance."""
    yield of_fem("FEM from rest", place.simulator, place)
    for tolerance in place.some(place.body.tolerances):
        loose = em.Simulator(
            place.scene, em.fem.NewtonOptions(tolerance=tolerance, round_off=tolerance)
        )
        yield of_fem(f"FEM from rest, tolerance {tolerance:g}", loose, place)


def series(place: Place) -> Iterator[Rung]:
    """Taylor series about the centre of the box."""
    for order in place.some(place.body.orders):
        seconds, forward = _series(place, order)
        label = f"series of order {order}"
        yield of_map(label, "series", forward, place.at, offline_s=seconds, fem_runs=1)


def discrepancy(place: Place) -> Iterator[Rung]:
    """Series and discrepancy model, and what stands on the one of most FEM runs."""
    for runs in place.some(place.body.runs):
        seconds, trained = clocked(mechanics, place.scene, runs, clock=CLOCK)
        label, forward = f"series + discrepancy, {runs} FEM runs", trained.cache()
        offline = {"offline_s": seconds, "fem_runs": runs + 1}
        yield of_map(label, "emulator", forward, place.at, **offline)
    yield from standing_on("emulator", forward, place, offline)


def reduced(place: Place) -> Iterator[Rung]:
    """POD and Gaussian processes."""
    for runs in place.some(place.body.reduced):
        seconds, fitted = clocked(_reduced, place, runs, clock=CLOCK)
        label = f"POD + GP, {runs} FEM runs"
        yield of_map(label, "POD + GP", fitted, place.at, offline_s=seconds, fem_runs=runs)


def loaded(place: Place) -> Iterator[Rung]:
    """What is shipped: the series; the graph network, cached and not, and one Newton step on it."""
    for label, name in place.body.shipped.items():
        made = shipped(name)
        before = {"offline_s": made.seconds, "fem_runs": made.fem_runs}
        kind = "network" if label == NETWORK else "emulator"
        yield of_map(label, kind, made.forward, place.at, **before)
        if label == NETWORK:
            uncached = em.load(name)
            yield Rung(f"{label}, full field", kind, place.scene, made.forward, full=True, **before)
            yield with_processor(f"{label}, processor in every call", uncached, place, before)
            polished = em.corrected(made.forward, place.simulator, steps=1)
            yield of_map(f"{label} + 1 Newton step", "polished", polished, place.at, **before)


def with_processor(name: str, emulator: em.Emulator, place: Place, before: dict[str, Any]) -> Rung:
    """A graph network without its cache; its weights are arguments, so that nothing is folded."""
    nodes, network = cal.landmarks(place.scene, place.at).nodes, emulator.network
    assert network is not None

    @jax.jit
    def program(weights: Any, theta: jax.Array) -> jax.Array:
        return replace(emulator, network=replace(network, weights=weights))(theta)[nodes]

    def solve(theta: jax.Array) -> jax.Array:
        return program(network.weights, theta)

    calls = place.body.calls
    return Rung(name, "network", place.scene, solve, compiled=False, calls=calls, **before)


def carried(place: Place) -> Iterator[Rung]:
    """An emulator of a coarse mesh, taken to the next finer one by a few runs there."""
    with TemporaryDirectory() as folder:
        seconds, pair = clocked(on_two_meshes, place.body.coarse(), Path(folder), clock=CLOCK)
    runs = sum(each.record["plan"]["simulations"] for each in pair)
    offline = {"offline_s": seconds, "fem_runs": runs}
    yield of_map("emulator of two meshes", "emulator", pair.fine.cache(), place.at, **offline)


def released(place: Place) -> Iterator[Rung]:
    """The network of Dalton et al. (2023); its training is not counted, nobody told it."""
    forward = em.released_network(place.body.model, place.published).cache()
    yield of_map("released network", "network", forward, place.at)
    yield from standing_on("released network", forward, place, {})


def standing_on(
    name: str, best: em.ForwardMap, place: Place, offline: dict[str, Any]
) -> Iterator[Rung]:
    """The full field of a map, FEM started by it, and Newton steps from it."""
    kind = "emulator" if name == "emulator" else "network"
    yield Rung(f"{name}, full field", kind, place.scene, best, full=True, **offline)
    yield of_fem(f"FEM started by the {name}", place.simulator, place, best, **offline)
    small = len(place.scene.mesh.nodes) < COMPILED
    for steps in (1, 2) if small else (1,):
        polished = em.corrected(best, place.simulator, steps=steps)
        label = f"{name} + {steps} Newton step{'s' if steps > 1 else ''}"
        rung = of_map(label, "polished", polished, place.at, **offline)
        yield replace(rung, compiled=small, calls=rung.calls if small else place.body.calls)


def other_meshes(place: Place) -> Iterator[Rung]:
    """FEM on coarser, finer and quadratic meshes."""
    for label, make in place.body.meshes.items():
        yield of_fem(f"FEM, {label}", em.Simulator(make()), place)


def float32(place: Place) -> Iterator[Rung]:
    """Maps made in float64 and evaluated in float32; those that need float64 refuse."""
    makes: dict[str, tuple[str, Callable[[], em.ForwardMap]]] = {
        "series of order 3": ("series", lambda: _series(place, 3)[1]),
        "POD + GP, 30 FEM runs": ("POD + GP", lambda: _reduced(place, 30)),
    }
    if NETWORK in place.body.shipped:
        makes |= {
            "series + discrepancy, 20 FEM runs": (
                "emulator", lambda: mechanics(place.scene, 20).cache()
            ),
            NETWORK: ("network", lambda: em.load(place.body.shipped[NETWORK]).cache()),
        }  # fmt: skip
    if place.body.model:
        network = em.released_network
        makes = {
            "released network": (
                "network", lambda: network(place.body.model, place.published).cache()
            )
        }  # fmt: skip
    for label, (kind, make) in makes.items():
        forward = make()
        name = f"{label}, float32"
        with jax.enable_x64(False):
            try:
                rung = of_map(name, kind, forward, place.at, narrow=True)
            except em.InputError as error:
                rung = Rung(name, kind, place.scene, _refusing(error), narrow=True)
        yield rung


STAGES: dict[str, Callable[[Place], Iterator[Rung]]] = {
    "from rest": from_rest,
    "series": series,
    "discrepancy": discrepancy,
    "reduced": reduced,
    "shipped": loaded,
    "two meshes": carried,
    "released": released,
    "meshes": other_meshes,
    "float32": float32,
}


def mechanics(scene: em.Scene, runs: int) -> em.Emulator:
    """A series of order 3 and a discrepancy model of so many FEM runs."""
    with TemporaryDirectory() as folder:
        return em.train(scene, replace(em.recipe("mechanics"), simulations=runs), folder)


def _series(place: Place, order: int) -> tuple[float, em.ForwardMap]:
    seconds, taylor = clocked(lambda: em.expand(place.simulator, order=order), clock=CLOCK)
    return seconds, em.Emulator(place.scene, taylor=taylor).cache()


def _reduced(place: Place, runs: int) -> em.ForwardMap:
    campaign = em.fem.run_campaign(place.simulator, em.fem.sobol(place.scene, runs, SEED))
    return em.fit_reduced(place.scene, campaign)


def _refusing(error: em.InputError) -> Solve:
    """A map that refuses as it was refused."""

    def solve(theta: jax.Array) -> jax.Array:  # noqa: ARG001 - whatever it is
        raise error

    return solve
