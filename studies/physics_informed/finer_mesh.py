"""From a ventricle's mesh to the next finer one, without a simulation and with some.

The shipped polynomial of sweeps is carried to the finer mesh, and sweeps there give the polynomial
of what it leaves; beside it ten FEM runs with their slopes on the finer mesh (recipe
``two_meshes``), which stand on the shipped emulator of 200 runs. Both start from emulators of the
coarse mesh that are there.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
from studies.common.output import Case
from studies.physics_informed.judged import TEST_SEED, errors_of

import emulator as em
from emulator.fem import Runs, run_campaign, sobol
from emulator.scenes.finer import finer
from emulator.surrogates import Emulator, load
from emulator.surrogates.coarse import carried
from emulator.training import Plan, recipe, train

TESTS = 6
WAYS: dict[str, tuple[str, Plan]] = {
    "3 sweeps": ("left_ventricle_physics", replace(recipe("sweeps"), sweeps=3)),
    "10 FEM runs": ("left_ventricle", recipe("two_meshes")),
}


def on_finer(way: str) -> Case:
    """Seconds of processor, memory and errors of a way, and of the coarse emulator alone."""
    body = finer(em.scenes.left_ventricle())
    name, plan = WAYS[way]
    start = load(name, body.coarse)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        found = train(body.scene, plan, folder, start=start)
    seconds = time.process_time() - began
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    told = found.record.get("sweeps", {})
    jax.clear_caches()
    known = nearby(em.Simulator(body.scene), found)
    alone = Emulator(body.scene, coarse=carried(start.parts, body))
    return {"finer": way, "nodes": len(body.scene.mesh.nodes), "processor_seconds": seconds,
            "peak_memory_gb": memory, "error_bar_mm": told.get("error_mm"),
            "errors": errors_of(found, known), "coarse_alone": errors_of(alone, known)}  # fmt: skip


def nearby(simulator: em.Simulator, found: Emulator) -> Runs:
    """FEM at theta that nothing has seen, each solve from where ``found`` says."""
    cached, scene = found.cache(), simulator.scene
    predictor: Callable[[Any], Any] = lambda position: cached(scene.from_unit(position))  # noqa: E731
    return run_campaign(simulator, sobol(scene, TESTS, TEST_SEED), predictor=predictor)
