"""Error and seconds of every method against the number of FEM runs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.few_runs.methods import (
    RIVAL_MODES,
    clock,
    fit_rival,
    fit_values,
    our_campaign,
    plain_kernel,
    rival_campaign,
    unscaled,
)

import emulator as em
from emulator.accuracy.comparison import quantiles
from emulator.fem import Runs, sobol
from emulator.scenes import BUILT_IN, Scene
from emulator.scenes.scene import find_cavity
from emulator.surrogates.discrepancy import fit_discrepancy
from emulator.surrogates.taylor import Expansion

SEED = 0
TEST_SEED = 90_210
ABLATED = (10, 30, 120)
CHECKED_MODES, CHECKED_RUNS = 80, 120

RIVAL = "POD + GP"
SERIES = "Taylor series"
OVER = "residual over the series"
PLAIN = "residual, no mean"
POSITIONS, VALUES = "positions only", "no slopes"


def scene_of(name: str, shape: tuple[int, int, int] | None = None) -> Scene:
    """A built-in ventricle of linear elements, on its own mesh or on one of ``shape``.

    That is rings, around, layers.
    """
    return BUILT_IN[name](*(shape or ()), order=1)


def design(scene: Scene, count: int) -> jax.Array:
    """Theta (count, p) of the FEM runs: the centre, then Sobol points."""
    return jnp.concatenate([scene.centre[None], sobol(scene, max(count, 2), SEED)])[:count]


class Court:
    """FEM solutions at the test theta, and the errors of fields against them."""

    def __init__(self, scene: Scene, count: int, series: Expansion) -> None:
        self.scene, self.thetas = scene, sobol(scene, count, TEST_SEED)
        self.positions = scene.to_unit(self.thetas)
        simulator = em.Simulator(scene)
        begin = clock()
        simulator.solve(scene.centre, series.displacement)  # compiles
        first = clock()
        self.compile_s = first - begin
        fields = [
            simulator.solve(theta, series(x)).require_converged("test").displacement
            for theta, x in zip(self.thetas, self.positions, strict=True)
        ]
        self.run_s = (clock() - first) / count  # a mean, late compilation included
        self.reference = jnp.stack(fields)
        self._cavity = find_cavity(scene)
        self._volume = jax.jit(lambda u: self._cavity(u[:, self._cavity.nodes]))
        self.volumes = self._volume(self.reference)

    def predict(self, over: Callable[[jax.Array], jax.Array]) -> jax.Array:
        """Fields (c, n, 3) in mm of ``over``, a map of positions in the unit box."""
        return jax.jit(jax.vmap(over))(self.positions)

    def errors(self, fields: jax.Array) -> dict[str, dict[str, float]]:
        distance = np.linalg.norm(np.asarray(fields - self.reference), axis=-1)
        volume = 100.0 * np.abs(np.asarray(self._volume(fields) / self.volumes) - 1.0)
        return {"err_u_mm": quantiles(distance), "err_V_percent": quantiles(volume)}


def seconds(pair: np.ndarray) -> dict[str, float]:
    return {"wall": round(float(pair[0]), 3), "processor": round(float(pair[1]), 3)}


def accuracy(
    name: str,
    counts: list[int],
    tests: int,
    order: int,
    shape: tuple[int, int, int] | None = None,
    keep: Callable[[list[dict]], object] = len,
) -> list[dict]:
    """All rows of one scene; after each new one ``keep`` is called with all so far."""
    scene = scene_of(name, shape)
    thetas = design(scene, max(counts))
    series, ours, expanded, elapsed = our_campaign(scene, thetas, order)
    rival_runs, rival_elapsed = rival_campaign(scene, thetas)
    # Starts differ, but the equilibria are the same: both methods have the same FEM runs.
    gap = jnp.max(jnp.abs(rival_runs.displacement - ours.displacement))
    assert gap < 1e-6 * jnp.max(jnp.abs(ours.displacement)), f"the campaigns differ by {gap} mm"
    court = Court(scene, tests, series)
    base = court.predict(series)
    cases: list[dict[str, Any]] = []

    def note(method: str, runs: int, fields: jax.Array, campaign, fitting, **more: Any) -> None:
        case = {
            "name": f"{name}, {method}, {runs} runs",
            "status": "done",
            "kind": "accuracy",
            "scene": name,
            "nodes": len(scene.mesh.nodes),
            "method": method,
            "runs": runs,
            **court.errors(fields),
            "campaign_s": seconds(campaign),
            "fit_s": seconds(fitting),
            "total_s": seconds(campaign + fitting),
            **more,
        }
        cases.append(case)
        keep(cases)
        print(
            f"{case['name']:60s} err_u {case['err_u_mm']['median']:.2e} mm  "
            f"total {case['total_s']['processor']:.1f} s",
            flush=True,
        )

    size = np.linalg.norm(np.asarray(court.reference), axis=-1)
    note(
        SERIES, 1, base, expanded, np.zeros(2),
        order=series.order, terms=len(series.indices), test_run_s=seconds(court.run_s),
        compile_fem_s=seconds(court.compile_s), displacement_mm=quantiles(size),
    )  # fmt: skip
    for count in (n for n in counts if n > 1):
        some, done = ours.take(slice(count)), elapsed[count - 1]
        fitted, took = _timed(lambda some=some: fit_discrepancy(scene, some, series, series))
        note(OVER, count, base + court.predict(fitted), done, took, modes=len(fitted.modes))
        alone, took = _timed(lambda some=some: fit_discrepancy(scene, some, series))
        note(PLAIN, count, court.predict(alone), done, took, modes=len(alone.modes))
        if count >= 3:
            _note_rival(note, court, some, rival_elapsed[count - 1], RIVAL_MODES)
    for count in (n for n in counts if n in ABLATED):
        some, done = ours.take(slice(count)), elapsed[count - 1]
        for method, fields, took in _ablations(court, some, series, base, fitted.warp):
            note(method, count, fields, done, took, ablation=True)
    if CHECKED_RUNS in counts:
        some, done = ours.take(slice(CHECKED_RUNS)), rival_elapsed[CHECKED_RUNS - 1]
        _note_rival(note, court, some, done, CHECKED_MODES)
    return cases


def _timed(function: Callable[[], Any]) -> tuple[Any, np.ndarray]:
    begin = clock()
    result = function()
    jax.block_until_ready(jax.tree.leaves(vars(result)))
    return result, clock() - begin


def _note_rival(note, court: Court, some: Runs, done: np.ndarray, modes: int) -> None:
    fitted, took = _timed(lambda: fit_rival(court.scene, some, modes))
    fields = jax.jit(jax.vmap(fitted))(court.thetas)
    method = RIVAL if modes == RIVAL_MODES else f"{RIVAL}, {modes} modes"
    note(method, len(some.theta), fields, done, took, modes=len(fitted.modes))


def _ablations(court: Court, some: Runs, series: Expansion, base: jax.Array, warp):
    """The discrepancy model without some of its parts: method, fields, seconds."""
    scene = court.scene
    for mean_map, below, name in ((series, base, OVER), (None, 0.0, PLAIN)):
        fitted, took = _timed(lambda m=mean_map: plain_kernel(scene, some, series, m))
        yield f"{name}, {POSITIONS}", below + court.predict(fitted), took
        for features, words in ((True, VALUES), (False, f"{VALUES}, {POSITIONS}")):
            bare = unscaled(warp, features)
            fitted, took = _timed(lambda w=bare, m=mean_map: fit_values(scene, some, w, m))
            yield f"{name}, {words}", below + court.predict(fitted), took
