"""The rungs: every way from theta to displacements, its error and its time.

Two errors, each the root mean square over the observed points: against FEM on the same mesh, taken
two Newton steps beyond its tolerance (what the rung adds), and against a mesh so fine that it
stands for the truth (what its user gets).
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.accuracy_vs_time.bodies import BODIES, Body, scene_of
from studies.common.output import Case
from studies.common.timing import unseen

import emulator as em
from calibrate.observations import landmarks, spread_landmarks
from emulator.fem import NewtonOptions, Simulator, run_campaign, sobol
from emulator.scenes import Scene
from emulator.surrogates.additive import Emulator
from emulator.surrogates.corrected import corrected, newton_step
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.protocol import ForwardMap
from emulator.surrogates.taylor import expand
from emulator.training import RECIPES, train

POINTS, SEED = 24, 4
TOLERANCES = (1e-3, 1e-6)
ORDERS = (1, 2, 3)
FAST_CALLS, SLOW_CALLS = 60, 5
Solve = Callable[[jax.Array], jax.Array]


@dataclass(frozen=True)
class Rung:
    """One way from theta (p,) to the displacements (k, 3) of the observed nodes, or of all.

    scene : whose mesh ``observed`` is of. calls : of each timing. offline_s, fem_runs : what had
    to be done before. compiled : whether a call is a compiled program. kind : for the figure.
    """

    name: str
    kind: str
    scene: Scene
    solve: Solve
    offline_s: float = 0.0
    fem_runs: int = 0
    compiled: bool = True
    full: bool = False

    @property
    def calls(self) -> int:
        return FAST_CALLS if self.compiled else SLOW_CALLS


def points(name: str) -> np.ndarray:
    """The observed material points of a body, (24, 3) mm."""
    return spread_landmarks(scene_of(name), POINTS, SEED)


def of_map(name: str, kind: str, forward: ForwardMap, at: np.ndarray, **more: Any) -> Rung:
    """A forward map decoded at the observed points' nodes."""
    return Rung(name, kind, forward.scene, forward.at(landmarks(forward.scene, at).nodes), **more)


def of_fem(
    name: str, simulator: Simulator, at: np.ndarray, start: Solve | None = None, **more: Any
) -> Rung:
    """FEM called from Python, from rest or started by a compiled map of the whole field."""
    nodes, begin = landmarks(simulator.scene, at).nodes, start and jax.jit(start)

    def solve(theta: jax.Array) -> jax.Array:
        first = None if begin is None else begin(jax.lax.stop_gradient(theta))
        return simulator.solve(theta, first).require_converged(name).displacement[nodes]

    return Rung(name, "FEM", simulator.scene, solve, compiled=False, **more)


def rungs(name: str, body: Body, *, quick: bool) -> Iterator[Rung]:
    """Every rung of a body; made one after the other, so that memory is that of one."""
    at, scene = points(name), scene_of(name)
    simulator = Simulator(scene)
    yield of_fem("FEM from rest", simulator, at)
    for tolerance in TOLERANCES:
        loose = Simulator(scene, NewtonOptions(tolerance=tolerance, round_off=tolerance))
        yield of_fem(f"FEM from rest, tolerance {tolerance:g}", loose, at)
    for order in ORDERS[:1] if quick else ORDERS:
        seconds, series = _clocked(lambda order=order: expand(simulator, order=order))
        forward = Emulator(scene, taylor=series).cache()
        label = f"series of order {order}"
        yield of_map(label, "series", forward, at, offline_s=seconds, fem_runs=1)
    for runs in body.runs[:1] if quick else body.runs:
        seconds, trained = _clocked(lambda runs=runs: mechanics(scene, runs))
        label = f"series + discrepancy, {runs} FEM runs"
        forward = trained.cache()
        offline = {"offline_s": seconds, "fem_runs": runs + 1}
        yield of_map(label, "emulator", forward, at, **offline)
    for runs in body.reduced[:1] if quick else body.reduced:
        campaign = lambda runs=runs: run_campaign(simulator, sobol(scene, runs, SEED))  # noqa: E731
        seconds, fitted = _clocked(lambda campaign=campaign: fit_reduced(scene, campaign()))
        label = f"POD + GP, {runs} FEM runs"
        yield of_map(label, "POD + GP", fitted, at, offline_s=seconds, fem_runs=runs)
    best: ForwardMap = forward
    if body.shipped:
        best, offline = _shipped(body.shipped[0])
        yield of_map("emulator as shipped", "emulator", best, at, **offline)
        alone, before = _shipped(body.shipped[1])
        yield of_map("network alone", "network", alone, at, **before)
    whole = Rung("emulator, full field", "emulator", scene, best, full=True, **offline)
    yield whole
    yield of_fem("FEM started by the emulator", simulator, at, best, **offline)
    for steps in (1, 2):
        polished = corrected(best, simulator, steps=steps)
        plural = "s" if steps > 1 else ""
        rung = of_map(
            f"emulator + {steps} Newton step{plural}", "polished", polished, at, **offline
        )
        yield replace(rung, compiled=len(scene.mesh.nodes) < 5000 and rung.compiled)
    for label, make in {} if quick else body.meshes.items():
        yield of_fem(f"FEM, {label}", Simulator(make()), at)


def mechanics(scene: Scene, runs: int) -> Emulator:
    """A series of order 3 and a discrepancy model of so many FEM runs."""
    with tempfile.TemporaryDirectory() as folder:
        return train(scene, replace(RECIPES["mechanics"], simulations=runs), folder)


def _shipped(name: str) -> tuple[ForwardMap, dict[str, Any]]:
    """A shipped emulator's map, and what was done for it."""
    trained = em.load(name)
    runs = trained.record["plan"]["simulations"] + 1
    return trained.cache(), {"offline_s": float(trained.record["seconds"]), "fem_runs": runs}


def _clocked(make: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    made = make()
    return time.perf_counter() - began, made


def measure(
    rung: Rung, at: np.ndarray, tests: jax.Array, exact: np.ndarray | None, truth: np.ndarray
) -> Case:
    """Errors at ``tests`` (c, p) against ``exact`` and ``truth`` (c, d, 3) mm, and times.

    exact : FEM on the rung's own mesh; None where the rung is that.
    """
    observe = landmarks(rung.scene, at)
    rows = observe.nodes if rung.full else slice(None)
    value, gradient = rung.solve, _gradient(rung.solve)
    if rung.compiled:
        value, gradient = jax.jit(value), jax.jit(gradient)
    found = [np.asarray(value(theta))[rows] for theta in tests]
    value_s, gradient_s = _median(value, rung), _median(gradient, rung)
    seen = np.stack([np.asarray(observe(jnp.asarray(u), None)) for u in found])
    return {
        "nodes": len(rung.scene.mesh.nodes),
        "kind": rung.kind,
        "rung": rung.name,
        "own_mm": None if exact is None else _errors(seen - exact),
        "truth_mm": _errors(seen - truth),
        "value_s": value_s,
        "gradient_s": gradient_s,
        "offline_s": rung.offline_s,
        "fem_runs": rung.fem_runs,
    }


def _gradient(solve: Solve) -> Callable[[jax.Array], jax.Array]:
    """Gradient of one scalar, which is what a sampler needs."""
    return jax.grad(lambda theta: jnp.sum(solve(theta) ** 2))


def _median(function: Solve, rung: Rung) -> float:
    """Median seconds of a call, none of which has met its theta before."""
    spent = []
    for theta in jax.block_until_ready(list(unseen(rung.scene, rung.calls + 1))):
        began = time.perf_counter()
        jax.block_until_ready(function(theta))
        spent.append(time.perf_counter() - began)
    return float(np.median(spent[1:]))


def _errors(gap: np.ndarray) -> dict[str, float]:
    """Root mean squares over the points (c, d, 3): median and largest over theta, mm."""
    each = np.sqrt(np.mean(np.sum(gap**2, axis=-1), axis=-1))
    return {"median": float(np.median(each)), "max": float(each.max())}


def solved(scene: Scene, at: np.ndarray, tests: jax.Array, *, steps: int = 0) -> np.ndarray:
    """FEM's displacements (c, d, 3) mm of the points, ``steps`` Newton steps beyond tolerance."""
    simulator, observe = Simulator(scene), landmarks(scene, at)
    fields = list(run_campaign(simulator, tests).displacement)
    if steps:
        beyond = jax.jit(lambda u, theta: _beyond(simulator, u, theta, steps))
        fields = [beyond(u, theta) for u, theta in zip(fields, tests, strict=True)]
    return np.stack([np.asarray(observe(u[observe.nodes], None)) for u in fields])


def _beyond(simulator: Simulator, u: jax.Array, theta: jax.Array, steps: int) -> jax.Array:
    """``u`` (n, 3) mm after some Newton steps."""
    for _ in range(steps):
        u = newton_step(simulator.system, u, theta)
    return u


def examine(name: str, *, quick: bool) -> Iterator[Case]:
    """All rungs of a body, one case each."""
    body, at = BODIES[name], points(name)
    tests = sobol(scene_of(name), 2 if quick else body.tests, 90_210)
    exact = solved(
        scene_of(name), at, tests, steps=2 if len(scene_of(name).mesh.nodes) < 5000 else 0
    )
    truth = exact if quick else solved(body.truth(), at, tests)
    for rung in rungs(name, body, quick=quick):
        # FEM on another mesh has no error of its own to speak of.
        own = exact if rung.scene.fingerprint == scene_of(name).fingerprint else None
        case = measure(rung, at, tests, own, truth)
        yield {"name": f"{name}: {rung.name}", "status": "done", "body": name, **case}
