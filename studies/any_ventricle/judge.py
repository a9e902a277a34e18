"""What is known of a ventricle before and after FEM runs on it, judged by FEM."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.arrays import read_arrays, save_arrays

import emulator as em

NETWORK = "ventricle_family"
THETA_SEED = 90_210
SWEEPS = (6, 30)
KEYS = ("err_u", "err_V")
_POD_RUNS = 20


def first_prediction(scene: em.Scene) -> tuple[em.Emulator, float]:
    """The network on ``scene``, and the seconds to its first displacement."""
    began = time.perf_counter()
    emulator = em.load(NETWORK, scene)
    jax.block_until_ready(emulator.cache()(scene.centre))
    return emulator, time.perf_counter() - began


def one(
    make: Callable[[], em.Scene], number: int, tests: int, more: tuple[bool, bool], kept: Path
) -> dict[str, Any]:
    """All about one ventricle.

    more : whether the series of one FEM run, and POD + GP of twenty, are judged too.
    kept : the file where FEM's part is kept, which no network changes.
    """
    scene = make()
    known, row = references(scene, number, tests, more, kept)
    network, seconds = first_prediction(scene)
    simulator, predict = em.Simulator(scene), jax.jit(network.cache())
    warm = [simulator.solve(theta, predict(theta)) for theta in known.theta]
    apart = [
        float(jnp.max(jnp.abs(solution.displacement - u)))
        for solution, u in zip(warm, known.displacement, strict=True)
    ]
    row |= {
        "before": judged(network.cache(), known),
        "seconds_to_first_prediction": round(seconds, 2),
        "factorisations_from_network": [int(s.factorisations) for s in warm],
        "largest_difference_mm": max(apart),
    }
    jax.clear_caches()
    return row


def references(
    scene: em.Scene, number: int, tests: int, more: tuple[bool, bool], kept: Path
) -> tuple[em.fem.Runs, dict[str, Any]]:
    """FEM's solutions at ``tests`` theta, and what needs no network; read where it is kept."""
    thetas = em.fem.sobol(scene, tests, THETA_SEED + number)
    if kept.is_file():
        arrays, metadata = read_arrays(kept)
        return _runs(thetas, arrays["u"]), json.loads(metadata["row"])
    simulator = em.Simulator(scene)
    rest = [simulator.solve(theta).require_converged() for theta in thetas]
    u = jnp.stack([solution.displacement for solution in rest])
    known = _runs(thetas, u)
    row: dict[str, Any] = {
        "nodes": len(scene.mesh.nodes),
        "mean_u_mm": float(jnp.linalg.norm(u, axis=-1).mean()),
        "factorisations_from_rest": [int(solution.factorisations) for solution in rest],
    }
    if more[0]:
        series = em.Emulator(scene, taylor=em.expand(simulator, order=3))
        row["one_run"] = judged(series.cache(), known)
    if more[1]:
        every = jnp.concatenate([scene.centre[None], em.fem.design(scene, _POD_RUNS - 1, 0)])
        row["pod_gp"] = judged(em.fit_reduced(scene, em.fem.run_campaign(simulator, every)), known)
    kept.parent.mkdir(parents=True, exist_ok=True)
    save_arrays(kept, {"u": np.asarray(u)}, {"row": json.dumps(row)})
    return known, row


def _runs(thetas: jax.Array, u: Any) -> em.fem.Runs:
    """Runs without energies, which no error here asks for."""
    return em.fem.Runs(thetas, jnp.asarray(u), jnp.zeros(len(thetas)))


def judged(forward: Any, known: em.fem.Runs) -> dict[str, dict[str, float]]:
    """Quantiles of the errors against FEM, over nodes and theta."""
    errors = em.evaluate(forward, known.theta, known.displacement)
    return {key: errors[key] for key in KEYS}


def swept(make: Callable[[], em.Scene], number: int, tests: int, kept: Path) -> dict[str, Any]:
    """Sweeps that begin where the network says: few of them, then many where those are refused."""
    scene = make()
    known, _ = references(scene, number, tests, (False, False), kept)
    rows: list[dict[str, Any]] = []
    for sweeps in SWEEPS:
        plan, began = replace(em.recipe("sweeps"), sweeps=sweeps), time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            try:
                emulator = em.train(scene, plan, folder, start=em.load(NETWORK))
            except em.SolverError as refusal:  # too few sweeps, and told so
                rows.append({"sweeps": sweeps, "refused": str(refusal)})
                continue
        seconds = round(time.perf_counter() - began, 1)
        rows.append(
            {"sweeps": sweeps, "seconds": seconds, "after": judged(emulator.cache(), known)}
        )
        break
    jax.clear_caches()
    return {"sweeps": rows}
