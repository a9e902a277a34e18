"""FEniCSx on our scenes, in a process and with forms of its own (``fenicsx_solver.py``).

It is given mesh, law, load, supports and theta, and solves from rest and from the solution of a
neighbouring theta, 3 % away in every entry. Our FEM solves the same, before it and on the same
core. Displacements and gradients of both are compared at every theta.
"""

import os
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import Case
from studies.common.timing import Clock, clocked

import emulator as em

AWAY = 0.03  # relative distance of a neighbour in every entry of theta
SPARE = 3  # theta for the choice of settings; the first is not timed
LIMIT = 1800.0  # s
_BLAS = ("OMP", "OPENBLAS")
PROGRAM = Path(__file__).with_name("fenicsx_solver.py")
Arrays = dict[str, Any]


def arrays(scene: em.Scene) -> Arrays:
    """The scene as plain arrays: what FEniCSx is told."""
    found: Arrays = {
        "nodes": scene.mesh.nodes,
        "elements": scene.mesh.elements,
        "law": scene.law.name,
        "names": np.array(scene.parameter_names),
        "constant_names": np.array(list(scene.constants), dtype=str),
        "constants": np.array(list(scene.constants.values()), dtype=float),
        "held": np.flatnonzero(scene.held.all(axis=1)),
        "prescribed": scene.held_displacement,
        "body_force": np.zeros(3),
    }
    if scene.fibres is not None:
        linear = scene.mesh.order == 1
        found["fibres"] = scene.fibres if linear else scene.fibres_at_points
        found["points"] = em.geometry.quadrature_points(scene.mesh.order)[:, 1:]
    for load in scene.loads:
        found |= _load(scene, load)
    return found


def _load(scene: em.Scene, load: object) -> Arrays:
    if isinstance(load, em.loads.Gravity):
        return {"body_force": load.body_force}
    if isinstance(load, em.loads.CavityPressure) and "pressure" in scene.parameter_names:
        return {"pressed": scene.mesh.facet_set(load.facet_set)}
    raise em.InputError(f"scene '{scene.name}': FEniCSx is not told of {type(load).__name__}")


def solve(python: str, problem: Arrays, program: Path = PROGRAM, threads: int | None = 1) -> Arrays:
    """What another code finds: ``program``, run by ``python``; FEniCSx's by default.

    threads : the threads of its BLAS; None for as many as it likes.
    """
    with TemporaryDirectory() as folder:
        task, answer = Path(folder) / "problem.npz", Path(folder) / "solutions.npz"
        np.savez(task, **problem)
        done = subprocess.run(
            [python, program, task, answer],
            capture_output=True, text=True, check=False, timeout=LIMIT, env=_environment(threads),
        )  # fmt: skip
        if done.returncode:
            raise SystemExit(f"{program.stem} by {Path(python).name}: {done.stderr[-2000:]}")
        with np.load(answer, allow_pickle=False) as file:
            return dict(file)


def _environment(threads: int | None) -> dict[str, str]:
    """This process's environment without the variables of this Python."""
    ours = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    each = {} if threads is None else {f"{blas}_NUM_THREADS": str(threads) for blas in _BLAS}
    return kept | each


# ---- the same by both ------------------------------------------------------------------------
def neighbours(thetas: jax.Array) -> jax.Array:
    """Each theta with every entry ``AWAY`` up or down."""
    signs = jax.random.rademacher(jax.random.key(1), thetas.shape, float)
    return thetas * (1.0 + AWAY * signs)


def compare(
    scene: em.Scene,
    observed: np.ndarray,
    thetas: jax.Array,
    python: str,
    clock: Clock = process_time,
) -> tuple[Case, ...]:
    """Ours from rest and warm, then FEniCSx's: times, displacements (c, n, 3), differences.

    Gradients are of ``sum |u|^2`` over the ``observed`` nodes. FEniCSx has a clock of its own,
    processor seconds.
    """
    simulator = em.Simulator(scene)
    starts = [simulator.solve(theta).displacement for theta in neighbours(thetas)]
    cold = _ours(simulator, observed, thetas, [None] * len(thetas), clock)
    warm = _ours(simulator, observed, thetas, starts, clock)
    spare = em.fem.uniform(scene, SPARE, jax.random.key(8))
    told = {
        **arrays(scene), "observed": observed, "theta": thetas, "starts": np.stack(starts),
        "spare": spare, "tolerance": em.fem.NewtonOptions().tolerance,
    }  # fmt: skip
    found = solve(python, told)
    # Theta that FEniCSx gave up on, in any number of load steps, count for nobody's time.
    done = (found["cold_iterations"] > 0) & (found["warm_iterations"] > 0)
    assert done.any(), "FEniCSx gave up at every theta"
    about = {
        "settings": str(found["settings"]),
        "load_steps": int(found["load_steps"]),
        "tried": found["tried"].tolist(),
        "compile_s": float(found["compile_s"]),
        "version": str(found["version"]),
        "gave_up": int((~done).sum()),
        "difference": _relative(found["cold_displacement"][done], cold["displacement"][done]),
        "gradient_difference": _relative(found["cold_gradient"][done], cold["gradient"][done]),
    }
    ours = [{**each, **_times(each, done)} for each in (cold, warm)]
    theirs = [
        {"displacement": found[f"{way}_displacement"], **_times(columns, done), **about}
        for way, columns in (
            (way, {key: found[f"{way}_{key}"] for key in ("seconds", "both_s", "iterations")})
            for way in ("cold", "warm")
        )
    ]
    return *ours, *theirs


def _ours(
    simulator: em.Simulator,
    observed: np.ndarray,
    thetas: jax.Array,
    starts: list[Any],
    clock: Clock,
) -> Case:
    """Our solves; a theta solved for its value is solved anew, a hair away, for its gradient."""

    def value(theta: jax.Array, start: Any) -> tuple[jax.Array, jax.Array]:
        u = simulator.solve(theta, start).require_converged("FEM").displacement
        return jnp.sum(u[observed] ** 2), u

    both = jax.value_and_grad(value, has_aux=True)
    pairs = list(zip(thetas, starts, strict=True))
    value(0.99 * thetas[0], starts[0])  # compiles
    both(0.98 * thetas[0], starts[0])
    values = [clocked(value, *pair, clock=clock) for pair in pairs]
    again = [clocked(both, theta * (1.0 + 1e-12), start, clock=clock) for theta, start in pairs]
    return {
        "displacement": np.stack([found[1][1] for found in values]),
        "gradient": np.stack([found[1][1] for found in again]),
        "seconds": np.array([found[0] for found in values]),
        "both_s": np.array([found[0] for found in again]),
    }


def _times(columns: Arrays, done: np.ndarray) -> Case:
    """Medians over the theta that are ``done``."""
    named = {"value_s": "seconds", "gradient_s": "both_s", "iterations": "iterations"}
    return {
        name: float(np.median(columns[key][done])) for name, key in named.items() if key in columns
    }


def _relative(theirs: np.ndarray, ours: np.ndarray) -> float:
    """Largest difference relative to the largest entry, theta by theta; the largest of them."""
    axes = tuple(range(1, ours.ndim))
    return float((np.abs(theirs - ours).max(axis=axes) / np.abs(ours).max(axis=axes)).max())
