"""One solve from Python and inside ``jit``: where its time goes, and FEniCSx beside it.

The parts of a solve are timed apart, each as the compiled program that the loop runs, on matrices
not met before, and multiplied by how often the solve needed them; what is left is calling.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.fenicsx import compare
from studies.common.output import Case
from studies.common.timing import clocked

import calibrate as cal
import emulator as em

SEED = 3
POINTS = 24


class Solved(NamedTuple):
    """Solves of several theta: median seconds, iterations, factorisations; the solutions."""

    seconds: float
    iterations: int
    factorisations: int
    solutions: list[em.fem.Solution]


def solved(solve: Callable[[jax.Array], em.fem.Solution], thetas: jax.Array) -> Solved:
    """``solve`` timed at each of ``thetas`` but the first, which compiles."""
    runs = [clocked(solve, theta) for theta in thetas]
    assert all(solution.converged for _, solution in runs)
    seconds, last = sorted((run[0], int(run[1].iterations)) for run in runs[1:]), runs[1:]
    middle = sorted(last, key=lambda run: run[0])[len(last) // 2][1]
    return Solved(
        seconds[len(seconds) // 2][0],
        int(middle.iterations),
        int(middle.factorisations),
        [solution for _, solution in runs],
    )


def median(function: Callable[[Any], Any], values: list[Any]) -> float:
    """Median seconds of ``function`` over ``values`` but the first, which compiles."""
    return float(np.median([clocked(function, value)[0] for value in values][1:]))


def parts(simulator: em.Simulator, theta: jax.Array, u: jax.Array, count: int) -> Case:
    """Seconds of a tangent, a residual, a factorisation and a substitution."""
    system = simulator.system
    fields = [u * (1.0 + 1e-6 * k) for k in range(count + 1)]
    tangent = jax.jit(lambda v: system.step_equations(v, theta, 1.0, 1.0)[0])
    residual = jax.jit(lambda v: system.balance(v, theta))
    attempt = jax.jit(lambda pair: system.attempt(*pair)[0])
    rhs = jnp.ones(len(system.free))
    tangents = [tangent(v) for v in fields]
    both = median(attempt, [(matrix, rhs) for matrix in tangents])
    again = median(attempt, [(tangents[-1], rhs * (1.0 + k)) for k in range(count + 1)])
    return {
        "tangent_s": median(tangent, [v * (1.0 + 1e-7) for v in fields]),
        "residual_s": median(residual, fields),
        "factorise_s": both - again,
        "substitute_s": again,
    }


def of_body(scene: em.Scene, count: int) -> Case:
    """A scene from rest at ``count`` theta, from Python and inside ``jit``, and its parts."""
    simulator, thetas = em.Simulator(scene), em.fem.sobol(scene, count + 1, SEED)
    python = solved(simulator.solve, thetas)
    inside = solved(jax.jit(em.Simulator(scene).solve), thetas)  # no factor of the other's
    each = parts(simulator, thetas[-1], python.solutions[-1].displacement, count)
    assembling = python.factorisations * each["tangent_s"] + python.iterations * each["residual_s"]
    spent = {
        "assembling": assembling,
        "factorising": python.factorisations * each["factorise_s"],
        "substituting": python.iterations * each["substitute_s"],
    }
    return {
        "nodes": len(scene.mesh.nodes),
        "python_s": python.seconds,
        "jit_s": inside.seconds,
        "iterations": python.iterations,
        "factorisations": python.factorisations,
        **each,
        "shares": {name: value / python.seconds for name, value in spent.items()},
    }


def parity(scene: em.Scene, count: int) -> Case:
    """Python and ``jit`` at ``count`` theta, the softest corner among them: the same iterates?"""
    # Simulators of their own, so that neither takes the other's factors.
    python, inside = em.Simulator(scene).solve, jax.jit(em.Simulator(scene).solve)
    corner = np.array([float(p.name == "pressure") for p in scene.parameters])
    softest = jnp.asarray(scene.from_unit(jnp.asarray(corner)))
    pairs = [(python(x), inside(x)) for x in (softest, *em.fem.sobol(scene, count - 1, SEED))]
    gaps = [
        float(jnp.abs(a.displacement - b.displacement).max() / jnp.abs(a.displacement).max())
        for a, b in pairs
    ]
    return {
        "thetas": count,
        "converged": sum(bool(a.converged) and bool(b.converged) for a, b in pairs),
        "same_iterations": sum(int(a.iterations) == int(b.iterations) for a, b in pairs),
        "largest_difference": max(gaps),
    }


def beside_fenicsx(scene: em.Scene, count: int, python: str) -> Case:
    """Seconds of ours and of FEniCSx, one after the other, and how far they differ.

    FEniCSx has one thread and processor seconds; ours is timed by the wall, as a user waits.
    """
    observed = cal.landmarks(scene, cal.spread_landmarks(scene, POINTS, SEED)).nodes
    thetas = em.fem.sobol(scene, count, SEED)
    found = compare(scene, observed, thetas, python, clock=time.perf_counter)
    cold, warm, theirs, theirs_warm = found
    dropped = ("displacement", "value_s", "gradient_s", "tried")
    return {
        "nodes": len(scene.mesh.nodes),
        "ours_s": cold["value_s"],
        "ours_warm_s": warm["value_s"],
        "fenicsx_s": theirs["value_s"],
        "fenicsx_warm_s": theirs_warm["value_s"],
        "times_as_long": theirs["value_s"] / cold["value_s"],
        **{name: value for name, value in theirs.items() if name not in dropped},
    }
