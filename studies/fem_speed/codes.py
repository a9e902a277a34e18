"""Times of ours and of scikit-fem with SciPy on one body, from rest, warm and with a gradient."""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.compiling import Compiling
from studies.common.output import Case
from studies.common.timing import clocked
from studies.fem_speed.plain_skfem import Body
from studies.fem_speed.problems import Problem, arrays, with_free_pressure

import emulator as em

SEED = 7
AWAY = 0.03  # relative distance of the theta of a warm start from the one to solve


def first_call(function: Callable[..., Any], *arguments: Any) -> tuple[float, float]:
    """Seconds of the first call, and how many of them JAX spent compiling."""
    compiling = Compiling()
    seconds, _ = clocked(function, *arguments)
    return seconds, compiling.so_far()


def row(name: str, seconds: Iterable[float], converged: Iterable[bool], **more: Any) -> Case:
    """A case of the study: median and extremes of the seconds of single calls."""
    seconds, converged = np.asarray(list(seconds)), list(converged)
    failures = len(converged) - sum(converged)
    case = {
        "name": name,
        "status": "converged" if not failures else f"{failures} of {len(converged)} failed",
        "median_s": float(np.median(seconds)),
        "least_s": float(seconds.min()),
        "most_s": float(seconds.max()),
        "calls": len(seconds),
        **more,
    }
    print(f"{name:42s} {case['status']:12s} median {case['median_s']:8.3f} s", flush=True)
    return case


def ours_cold(simulator: em.Simulator, thetas: jax.Array) -> tuple[Case, np.ndarray]:
    """From rest; the first theta pays for compilation and the symbolic factorisation."""
    first, compile_s = first_call(simulator.solve, thetas[0])
    runs = [clocked(simulator.solve, theta) for theta in thetas[1:]]
    seconds = [run[0] for run in runs]
    solutions = [run[1] for run in runs]
    case = row(
        "ours, cold",
        seconds,
        [bool(s.converged) for s in solutions],
        iterations=float(np.median([int(s.iterations) for s in solutions])),
        first_call_s=first,
        compile_s=compile_s,
    )
    return case, np.stack([s.displacement for s in solutions])


def neighbours(thetas: jax.Array) -> jax.Array:
    """Each theta with every entry ``AWAY`` up or down."""
    signs = jax.random.rademacher(jax.random.key(SEED), thetas.shape, float)
    return thetas * (1.0 + AWAY * signs)


def ours_warm(simulator: em.Simulator, thetas: jax.Array) -> Case:
    """Started from the solution at a neighbouring theta."""
    starts = [simulator.solve(theta).displacement for theta in neighbours(thetas)]
    first, compile_s = first_call(simulator.solve, thetas[0], starts[0])
    runs = [clocked(simulator.solve, *pair) for pair in zip(thetas[1:], starts[1:], strict=True)]
    seconds = [run[0] for run in runs]
    return row(
        "ours, warm",
        seconds,
        [bool(run[1].converged) for run in runs],
        iterations=float(np.median([int(run[1].iterations) for run in runs])),
        first_call_s=first,
        compile_s=compile_s,
    )


def wall_volume(scene: em.Scene, facet_set: str) -> Callable[[jax.Array], jax.Array]:
    """Displacement (n, 3) mm to the volume in mL between a facet set and lids on its openings.

    Unlike a cavity's it may be zero at rest: the slab's pressed face is flat.
    """
    facets = scene.mesh.facet_set(facet_set)
    volume: Callable[[jax.Array], jax.Array] = em.geometry.enclosed_volume(facets)
    return lambda u: volume(scene.mesh.nodes + u) / 1000.0


def ours_gradient(simulator: em.Simulator, facet_set: str, thetas: jax.Array) -> Case:
    """Cavity volume with its gradient in theta and pressure, from a neighbour's solution.

    Differentiated outside ``jit``, where CHOLMOD may try first.
    """
    volume = jax.jit(wall_volume(simulator.scene, facet_set))

    def value(theta: jax.Array, start: jax.Array) -> tuple[jax.Array, jax.Array]:
        solution = simulator.solve(theta, start)
        return volume(solution.displacement), solution.status

    both = jax.value_and_grad(value, has_aux=True)
    starts = [simulator.solve(theta).displacement for theta in neighbours(thetas)]
    first, compile_s = first_call(both, thetas[0], starts[0])
    runs = [clocked(both, *pair) for pair in zip(thetas[1:], starts[1:], strict=True)]
    seconds = [run[0] for run in runs]
    return row(
        "ours, warm, volume and gradient",
        seconds,
        [int(run[1][0][1]) == em.fem.Status.CONVERGED for run in runs],
        first_call_s=first,
        compile_s=compile_s,
        gradient_error=_slope_error(simulator, value, thetas[1], runs[0][1][1]),
    )


def _slope_error(
    simulator: em.Simulator, value: Callable, theta: jax.Array, gradient: jax.Array
) -> float:
    """Relative error of the gradient along one direction, against central differences."""
    step = 1e-4 * theta
    start = simulator.solve(theta).displacement
    ahead, behind = value(theta + step, start)[0], value(theta - step, start)[0]
    slope = jnp.vdot(gradient, step)
    return float(jnp.abs(0.5 * (ahead - behind) / slope - 1.0))


def relative_difference(u: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference at any node, relative to the largest displacement, over all theta."""
    scale = np.abs(reference).max(axis=(1, 2))
    return float((np.abs(u - reference).max(axis=(1, 2)) / scale).max())


def plain(problem: Problem, thetas: jax.Array, reference: np.ndarray) -> Case:
    """scikit-fem and SciPy, in the number of load steps that needs the fewest iterations."""
    body = Body(**arrays(problem))
    spare = np.asarray(em.fem.uniform(problem.scene, 3, jax.random.key(SEED + 2)))
    steps = min(
        (1, 2, 3, 4, 6), key=lambda k: sum(body.solve(theta, k).iterations for theta in spare)
    )
    runs = [clocked(body.solve, np.asarray(theta), steps) for theta in thetas[1:]]
    return row(
        "scikit-fem + SciPy, cold",
        [run[0] for run in runs],
        [run[1].converged for run in runs],
        iterations=float(np.median([run[1].iterations for run in runs])),
        load_steps=steps,
        difference=relative_difference(np.stack([run[1].displacement for run in runs]), reference),
    )


def compare(problem: Problem, count: int) -> list[Case]:
    """Ours and scikit-fem at ``count`` theta, after one that compiles."""
    scene, free_scene = problem.scene, with_free_pressure(problem)
    # New theta for each way of calling: factors of solved ones may be kept.
    cold, warm, slope = (
        em.fem.uniform(body, count + 1, jax.random.key(SEED + number))
        for number, body in enumerate((scene, free_scene, free_scene), start=10)
    )
    case, reference = ours_cold(em.Simulator(scene), cold)
    free = em.Simulator(free_scene)
    cases = [
        case,
        ours_warm(free, warm),
        ours_gradient(free, problem.facet_set, slope),
        plain(problem, cold, reference),
    ]
    about = {"problem": problem.name, "nodes": len(scene.mesh.nodes)}
    return [{**about, "elements": len(scene.mesh.elements), **case} for case in cases]
