"""What worker processes do: FEM runs of a ventricle, and all about one that is judged."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import emulator as em
from emulator.accuracy.comparison import case_errors, quantiles
from emulator.core.store import save_arrays
from emulator.fem.campaign import Runs, run_campaign
from emulator.fem.campaign.designs import design, sobol
from emulator.scenes.built_in.ventricles import left_ventricle
from emulator.scenes.scene import Scene, all_nodes
from emulator.surrogates import Emulator, load
from emulator.surrogates.pod_gp import fit_reduced
from emulator.surrogates.taylor import constant, expand_at
from emulator.training import recipe
from emulator.training import train as train_emulator
from emulator.training.mechanics import add_discrepancy

THETA_SEED = 90_210
NETWORK = "ventricle_family"
RUNS = (1, 5, 20)
KEYS = ("err_u", "err_V")


def solved(folder: Path, arguments: dict[str, Any], positions: np.ndarray, name: str) -> None:
    """FEM runs of one ventricle, written as one file; those that fail are left out."""
    path = folder / f"{name}.safetensors"
    if path.is_file():
        return
    scene = left_ventricle(**arguments)
    simulator = em.Simulator(scene)
    found = [simulator.solve(scene.from_unit(jnp.asarray(x))) for x in positions]
    converged = np.array([bool(s.converged) for s in found])
    fields = np.stack([np.asarray(s.displacement, np.float32) for s in found])
    save_arrays(path, {"position": positions[converged], "displacement": fields[converged]})
    jax.clear_caches()
    print(f"{name}: {len(scene.mesh.nodes)} nodes, {converged.sum()} of {len(found)}", flush=True)


def judged(emulator: Any, known: Runs) -> dict[str, dict[str, float]]:
    """Quantiles of the errors against FEM, over nodes and theta."""
    fields = case_errors(emulator, known.theta, known.displacement).fields
    return {key: quantiles(fields[key]) for key in KEYS}


def first_prediction(scene: Scene, start: Emulator) -> tuple[Emulator, float]:
    """The network on ``scene``, and the seconds to its first displacement."""
    began = time.perf_counter()
    emulator = train_emulator(scene, recipe("family"), "unused", start=start)
    jax.block_until_ready(emulator.cache()(scene.centre))
    return emulator, time.perf_counter() - began


def after_runs(scene: Scene, network: Emulator, known: Runs) -> list[dict[str, Any]]:
    """Errors of three ways to use 1, 5 and 20 FEM runs."""
    simulator, rows = em.Simulator(scene), []
    thetas = jnp.concatenate([scene.centre[None], design(scene, max(RUNS) - 1, 0)])
    runs = run_campaign(simulator, thetas, sensitivities=True)
    series = expand_at(simulator, runs.displacement[0], scene.centre, 3)
    assert network.family is not None
    rest = series.less(network.family.cache(all_nodes(scene)))
    own = Emulator(scene, taylor=series)
    started = replace(network, taylor=rest)
    for count in RUNS:
        some = runs.take(slice(0, count))
        maps: dict[str, Any] = {"mechanics": own, "network": started}
        if count > 1:
            maps["mechanics"] = add_discrepancy(own, some)[0]
            maps["network"], record = add_discrepancy(started, some, series)
        errors = {name: judged(emulator.cache(), known) for name, emulator in maps.items()}
        if count >= 3:
            others = run_campaign(simulator, sobol(scene, count, 0))
            errors["POD + GP"] = judged(fit_reduced(scene, others), known)
        on = record["on"] if count > 1 else "family + taylor"
        rows.append({"runs": count, "errors": errors, "network_on": on})
    return rows


def warm_starts(scene: Scene, network: Emulator, known: Runs) -> dict[str, Any]:
    """Factorisations and iterations of FEM from rest, and from the network's prediction."""
    simulator, predict = em.Simulator(scene), jax.jit(network.cache())
    rest = [simulator.solve(theta) for theta in known.theta]
    warm = [simulator.solve(theta, predict(theta)) for theta in known.theta]
    same = [
        float(jnp.max(jnp.abs(a.displacement - b.displacement)))
        for a, b in zip(rest, warm, strict=True)
    ]
    return {
        "factorisations_from_rest": [int(s.factorisations) for s in rest],
        "factorisations_from_network": [int(s.factorisations) for s in warm],
        "largest_difference_mm": max(same),
        "converged": all(bool(s.converged) for s in [*rest, *warm]),
    }


def one(number: int, arguments: dict[str, Any], theta: int, few_runs: bool) -> dict[str, Any]:
    """All about one ventricle."""
    scene = left_ventricle(**arguments)
    start = load(NETWORK)
    first_prediction(left_ventricle(order=1), start)  # imports, and programs that fit any mesh
    network, seconds = first_prediction(scene, start)
    known = run_campaign(em.Simulator(scene), sobol(scene, theta, THETA_SEED + number))
    before = judged(network.cache(), known)
    centre = Emulator(scene, taylor=constant(
        np.full(5, 0.5), em.Simulator(scene)(scene.centre)))  # fmt: skip
    size = jnp.linalg.norm(known.displacement, axis=-1)
    row: dict[str, Any] = {
        "name": f"ventricle {number}",
        "status": "done",
        "arguments": arguments,
        "nodes": len(scene.mesh.nodes),
        "mean_u_mm": float(size.mean()),
        "before": before,
        "one_solution_everywhere": judged(centre.cache(), known),
        "warm_start": warm_starts(scene, network, known),
        "after": after_runs(scene, network, known) if few_runs else [],
        "seconds_to_first_prediction": round(seconds, 2),
    }
    jax.clear_caches()
    return row
