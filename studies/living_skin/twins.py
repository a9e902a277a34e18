"""Twins: skins of FEM whose truth is known, inferred with errors that correlate and without."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case, Results
from studies.living_skin.bands import ALONG, FORCE_SD, LENGTH, SD
from studies.living_skin.skin import FORCE, Measured

import calibrate as cal
import emulator as em

SIZE = 0.05  # mm, of the twins' errors that correlate
_ERROR = {
    "kind": "field", "of": "displacement", "along": "pull", "length": LENGTH, "along_length": ALONG,
}  # fmt: skip


def _stiffness(scene: em.Scene, values: Mapping[str, jax.Array]) -> jax.Array:
    """Return the factor (m,) on each element's stiffness: its region's, and its modes'."""
    factor = jnp.ones(len(scene.mesh.elements))
    for label in () if scene.regions is None else np.unique(scene.regions):
        factor = jnp.where(scene.regions == label, factor * values[f"stiffness_{label}"], factor)
    if scene.stiffness_modes is not None:
        sizes = [
            values[f"stiffness_mode_{k}"] for k in range(1, scene.stiffness_modes.shape[1] + 1)
        ]
        factor = factor * jnp.exp(scene.stiffness_modes @ jnp.stack(sizes))
    return factor


def twins_of(
    scene: em.Scene, forward: em.ForwardMap, measured: Measured, frames: tuple[str, ...],
    count: int, results: Results,
) -> list[Case]:  # fmt: skip
    """Inference of ``count`` skins without a field of stiffness, seen as the keloid was."""
    seen = measured.field.only(frames, measured.chosen)
    observe, shapes = cal.fields.field_data(scene, seen, measured.amounts)
    parts = {
        **observe.parts,
        **{f"{FORCE}@{frame}": cal.Reaction(scene, "moving", "x") for frame in frames},
    }
    known = {f"pull@{frame}": measured.amounts[frame] for frame in frames}

    def model(sd: dict[str, float]) -> cal.Model:
        noise = {"displacement": cal.GaussianNoise(**sd), FORCE: cal.GaussianNoise(sd=FORCE_SD)}
        return cal.model(forward, parts, noise, known=known)

    plain = model({"sd": SD})
    stand_in = {name: np.asarray(values) for name, values in shapes.items()}
    stand_in |= {f"{FORCE}@{f}": np.array(measured.force(measured.amounts[f])) for f in frames}
    # Modes of the error do not depend on data: one model, and its programs, serve all twins.
    truth_of, _ = cal.with_described_errors(plain, stand_in, {"missed": {**_ERROR, "sd": SIZE}})
    told, _ = cal.with_described_errors(plain, stand_in, {"missed": {**_ERROR, "sd_scale": 0.1}})
    independent = model({"sd_scale": 0.1}).given(stand_in)[0]
    simulator = em.Simulator(scene)

    def twin(number: int) -> Case:
        rng, key = np.random.default_rng(number), jax.random.key(number)
        for attempt in range(20):
            drawn = plain.prior_draws(jax.random.fold_in(key, attempt), 1)
            truth = {name: float(values[0]) for name, values in drawn.items()}
            draw = {name: jnp.asarray(value) for name, value in truth.items()}
            thetas = truth_of.states.thetas(draw)
            try:
                fields = [simulator.solve(t).require_converged().displacement for t in thetas]
                break
            except em.SolverError:
                continue
        u = jnp.stack(fields)[:, truth_of.observe.nodes]
        means = truth_of.means_with_errors(key, draw, truth_of.observe(u, thetas))
        data = {
            name: np.asarray(mean) + truth_of.noise[name].simulate(rng, np.shape(mean))
            for name, mean in means.items()
        }
        return {
            "truth": truth,
            "correlated": _inside(told, data, truth, "auto"),
            "independent": _inside(independent, data, truth, "laplace"),
        }

    return [results.case(f"twin {k}", lambda k=k: twin(k)) for k in range(count)]


def _inside(
    model: cal.Model, data: dict[str, np.ndarray], truth: dict[str, float], sampler: str
) -> Case:
    options = cal.samplers.LaplaceOptions(draws=300, starts=2) if sampler == "laplace" else None
    found = cal.sample(model, data, sampler=sampler, options=options, seed=1, predictions=False)
    rows = {}
    for name, values in found.draws().items():
        if name in truth:
            low, high = (float(x) for x in np.quantile(values, (0.05, 0.95)))
            rows[name] = {"low": low, "high": high, "inside": bool(low <= truth[name] <= high)}
    return rows


def stiffness_logs(found: cal.Posterior, scene: em.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Middles (m, 2) mm of the region's elements, and draws (s, m) of the log of mu s in kPa."""
    thetas = found.thetas(found.model.states.states[0])
    thetas = thetas[np.linspace(0, len(thetas) - 1, 150).astype(int)]
    first = next(name for name in scene.parameter_names if name in scene.law.shape_moduli)
    inside = np.flatnonzero(scene.regions == 1)
    middles = scene.mesh.nodes[scene.mesh.corners].mean(axis=1)[inside, :2]

    @jax.jit
    def logs(theta: jax.Array) -> jax.Array:
        values = scene.resolve(theta)
        stiffness = _stiffness(scene, values)
        return jnp.log(stiffness[inside] * values[first])

    return middles, np.asarray(jax.vmap(logs)(thetas))


def inclusion_twin(
    scene: em.Scene, forward: em.ForwardMap, model_of: Callable[..., Any], measured: Measured,
    frames: tuple[str, ...], number: int,
) -> Case:  # fmt: skip
    """A scar with a round stiff inclusion, of which the model with modes of stiffness is not told.

    scene, forward : those of the scar with modes. model_of : the study's own model of frames.
    """
    rng, key = np.random.default_rng(1000 + number), jax.random.key(1000 + number)
    scar = np.flatnonzero(scene.regions == 1)
    middles = scene.mesh.nodes[scene.mesh.corners].mean(axis=1)[:, :2]
    candidates = middles[scar][(middles[scar, 0] > 3.0) & (middles[scar, 0] < 35.0)]
    centre, radius = rng.choice(candidates), rng.uniform(4.0, 7.0)
    stiff = np.linalg.norm(middles - centre, axis=1) < radius
    regions = np.where(stiff & (scene.regions == 1), 2, scene.regions)
    factor, mu = float(rng.uniform(3.0, 6.0)), float(rng.uniform(2.0, 5.0))
    ranges = {parameter.name: parameter for parameter in scene.parameters}
    around = replace(ranges["stiffness_1"], name="stiffness_2", high=100.0)
    kept = tuple(each for each in scene.parameters if "mode" not in each.name)
    exact = replace(
        scene, regions=regions, stiffness_modes=None, parameters=(*kept, around), origin={}
    )
    truth = {"mu": mu, "foundation": 0.003, "prestress": 5.0, "stiffness_1": 4.0}
    simulator, fields = em.Simulator(exact), []
    for frame in frames:
        theta = exact.theta(**truth, stiffness_2=4.0 * factor, pull=measured.amounts[frame])
        fields.append(simulator.solve(theta).require_converged().displacement)
    model, _ = model_of(scene, forward, measured, frames, known_size=SIZE)
    u = jnp.stack(fields)[:, model.observe.nodes]
    draw = {name: jnp.asarray(0.0) for name in model.names}
    draw |= {name: jnp.asarray(value) for name, value in truth.items()}
    means = model.means_with_errors(key, draw, model.observe(u, model.states.thetas(draw)))
    data = {
        name: np.asarray(mean) + model.noise[name].simulate(rng, np.shape(mean))
        for name, mean in means.items()
    }
    told, _ = model_of(scene, forward, measured, frames)
    options = cal.samplers.LaplaceOptions(draws=300, starts=2)
    found = cal.sample(told, data, sampler="laplace", options=options, seed=1, predictions=False)
    places, logs = stiffness_logs(found, scene)
    real = np.log(mu * np.where(stiff[scar], 4.0 * factor, 4.0))
    low, high = np.quantile(logs, (0.05, 0.95), axis=0)
    inside = (real >= low) & (real <= high)
    return {
        "centre_mm": centre.tolist(),
        "radius_mm": float(radius),
        "factor": factor,
        "elements": len(scar),
        "inside": float(np.mean(inside)),
        "inside_inclusion": float(np.mean(inside[stiff[scar]])),
        "middles_mm": places.round(2).tolist(),
        "truth_log_kpa": real.round(3).tolist(),
        "mean_log_kpa": logs.mean(axis=0).round(3).tolist(),
        "sd": logs.std(axis=0).round(3).tolist(),
    }


def coverage(cases: list[Case]) -> Case:
    """The share of twins whose 90 % interval holds the truth, by the errors that were assumed."""
    return {
        way: {
            name: float(np.mean([case[way][name]["inside"] for case in cases]))
            for name in cases[0][way]
        }
        for way in ("correlated", "independent")
        if cases
    }
