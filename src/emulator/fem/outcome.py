"""The outcome of a solve as plain JSON, and as VTU: status, energy, volumes, forces of supports."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from emulator.fem.energy import potential_energy, volume_ratio
from emulator.fem.fields import element_fields
from emulator.fem.reactions import supported_sets
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Solution, Status
from emulator.fem.unloading import Unloaded
from emulator.geometry.facets import Cavity
from emulator.geometry.io import write_solution
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, cavity_sets


def by_name(problem: ForwardProblem, theta: Any) -> dict[str, float]:
    """Return the entries of a theta (p,) by their parameters' names."""
    return dict(zip(problem.parameter_names, map(float, theta), strict=True))


def described(
    problem: ForwardProblem, theta: jax.Array, solution: Solution | Unloaded
) -> dict[str, Any]:
    """Return scene, theta (p,), and how the solve ended."""
    return {
        "scene": problem.name,
        "theta": by_name(problem, theta),
        "status": Status(int(solution.status)).name.lower(),
        "iterations": int(solution.iterations),
        "residual": float(solution.residual),
        "load_reached": float(solution.load_reached),
    }


def equilibrium(simulator: Simulator, theta: jax.Array, solution: Solution) -> dict[str, Any]:
    """Return energy, stability, volume ratios, cavity volumes and forces of supports.

    Energy and stability are None where there are none: under a follower pressure on an open patch.
    Where the mesh is the loaded shape, they and forces belong to the scene at rest.
    """
    scene, u, converged = simulator.scene, solution.displacement, bool(solution.converged)
    J = np.asarray(jax.jit(partial(volume_ratio, scene))(u))
    at_rest = not scene.loaded_by
    has_potential = at_rest and all(load.has_potential for load in scene.loads)
    result: dict[str, Any] = {
        "energy": float(jax.jit(potential_energy(scene))(u, theta)) if has_potential else None,
        "stable": simulator.is_stable(u, theta) if has_potential and converged else None,
        "max_displacement": float(np.linalg.norm(u, axis=1).max()),
        "J_range": [float(J.min()), float(J.max())],
        "volumes": cavity_volumes(scene, u),
    }
    if converged:
        supports = supported_sets(scene) if at_rest else ()
        result["reactions"] = {n: simulator.reaction(n, u, theta).tolist() for n in supports}
    return result


def cavity_volumes(
    scene: Scene, u: jax.Array, error_of: Callable[[Any], Any] | None = None
) -> dict[str, dict[str, float | None]]:
    """Return each cavity's volume in mL at rest, at ``u`` (n, 3) mm, and its estimated error.

    error_of : the function that estimates the error of a function of the displacement.
    """
    result: dict[str, dict[str, float | None]] = {}
    for name in cavity_sets(scene):
        cavity = Cavity(scene.mesh, name)

        def volume(u: jax.Array, cavity: Cavity = cavity) -> jax.Array:
            return cavity(u[cavity.nodes])

        error = None if error_of is None else float(error_of(volume))
        loaded = float(jax.jit(volume)(u))
        result[name] = {"rest_ml": float(cavity.rest), "volume_ml": loaded, "error_ml": error}
    return result


def write_outcome(path: str | Path, scene: Scene, u: jax.Array, theta: jax.Array) -> None:
    """Write displacement (n, 3) mm, stress, strain and fibres as VTU.

    Where the mesh is the loaded shape, stress and strain are those of the scene at rest, and left
    out.
    """
    fields = {} if scene.loaded_by else element_fields(scene, u, theta)
    write_solution(path, scene.mesh, np.asarray(u), fields)
