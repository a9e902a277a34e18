"""A beam under its weight by ours, torch-fem and FElupe, on the same meshes of growing size.

Both run in one environment of their own, as their users call them (``torchfem_solver.py``,
``felupe_solver.py``), with MKL PARDISO on all cores. All start from rest, and what compiles or
builds a mesh is not timed.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.fenicsx import solve
from studies.common.output import Case
from studies.common.timing import clocked

import emulator as em

PROGRAMS = {"torch-fem": "torchfem_solver.py", "FElupe": "felupe_solver.py"}
BEAMS = {
    "linear, 30 x 14 x 14 cells": ((30, 14, 14), 1),
    "linear, 48 x 22 x 22 cells": ((48, 22, 22), 1),
    "linear, 60 x 28 x 28 cells": ((60, 28, 28), 1),
    "quadratic, 12 x 5 x 5 cells": ((12, 5, 5), 2),
    "quadratic, 16 x 8 x 8 cells": ((16, 8, 8), 2),
}
QUICK = {"linear, 8 x 2 x 2 cells": ((8, 2, 2), 1)}
THETAS = np.array([[66.0, 77.0], [60.0, 70.0], [75.0, 62.0], [55.0, 85.0]])  # mu, lam in kPa
"""The first one compiles and is not timed."""


def beam(cells: tuple[int, int, int], order: int) -> em.Scene:
    """100 x 30 x 30 mm, held at its left end: the tip sinks by 10 mm."""
    return em.Scene(
        name="thick_beam",
        mesh=em.generators.box((100.0, 30.0, 30.0), cells, order=order),
        law=em.find_law("neo_hookean"),
        parameters=tuple(em.Parameter(name, "kPa", 20.0, 200.0, "log") for name in ("mu", "lam")),
        loads=(em.loads.Gravity(),),
        supports=(em.Support("left"),),
    )


def beside(cells: tuple[int, int, int], order: int, python: str) -> Case:
    """Median seconds of a solve by each code, and the largest difference of displacements."""
    scene = beam(cells, order)
    simulator, rows = em.Simulator(scene), list[tuple[float, em.fem.Solution]]()
    for theta in THETAS:
        rows.append(clocked(simulator.solve, jnp.asarray(theta)))
    solutions = [solution.require_converged("FEM") for _, solution in rows[1:]]
    value = lambda theta: jnp.sum(simulator.solve(theta).displacement ** 2)  # noqa: E731
    both = [clocked(jax.value_and_grad(value), jnp.asarray(t * (1.0 + 1e-12)))[0] for t in THETAS]
    u = np.stack([solution.displacement for solution in solutions])
    seconds = float(np.median([row[0] for row in rows[1:]]))
    found: Case = {
        "nodes": len(scene.mesh.nodes),
        "elements": len(scene.mesh.elements),
        "beam_s": seconds,
        "beam_gradient_s": float(np.median(both[1:])) - seconds,
        "iterations": int(np.median([int(s.iterations) for s in solutions])),
        "factorisations": int(np.median([int(s.factorisations) for s in solutions])),
        "tip_mm": float(np.abs(u).max()),
    }
    weight = simulator.system.external_force(simulator.rest, jnp.asarray(THETAS[0]))
    problem: dict[str, Any] = {
        "nodes": scene.mesh.nodes,
        "elements": scene.mesh.elements.astype(np.int64),
        "held": np.flatnonzero(scene.held.all(axis=1)),
        "force": np.asarray(weight),
        "theta": THETAS[1:],
    }
    for name, program in PROGRAMS.items():
        theirs = solve(python, problem, Path(__file__).with_name(program), threads=None)
        found[name] = {
            "seconds": float(np.median(theirs["seconds"])),
            "times_as_long": float(np.median(theirs["seconds"])) / seconds,
            "difference": float(np.abs(theirs["displacement"] - u).max() / np.abs(u).max()),
            "version": str(theirs["version"]),
        }
        if "gradient_s" in theirs:
            found[name]["gradient_s"] = float(np.median(theirs["gradient_s"]))
    return found
