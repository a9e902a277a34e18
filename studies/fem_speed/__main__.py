"""How fast the finite elements are: the ventricle against scikit-fem and FEniCS, cubes by size.

    python -m studies.fem_speed --published DIR [--fenics-python PYTHON]
    python -m studies.fem_speed --quick --out DIR    # a small plate and two small cubes

Writes results.json and speed.png, and asserts what the README of the study says.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.compiling import Compiling
from studies.common.output import save
from studies.common.processes import run
from studies.common.timing import clocked
from studies.fem_speed.plain_skfem import Body

import emulator as em
from calibrate.figures.drawing import pyplot
from calibrate.provenance import study_header
from emulator.fem import Status, uniform
from emulator.geometry.bodies.box import box
from emulator.geometry.facets import enclosed_volume
from emulator.mechanics.laws import find_law
from emulator.released.scenes import published_scene
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.store import write_json

HERE = Path(__file__).parent
SEED = 7
PRESSURE = 8.0 * KPA_PER_MMHG
CUBES = (6, 9, 13, 19, 27)
AWAY = 0.03  # relative distance of the theta of a warm start from the one to solve
LIMIT = 900.0  # seconds for one cube


class Problem(NamedTuple):
    """A pressurised body: its scene at the fixed pressure, and the facets the pressure acts on."""

    name: str
    scene: Scene
    facet_set: str


def ventricle(root: Path) -> Problem:
    """The released left ventricle, with the exact cavity pressure in place of the released one."""
    scene = published_scene("LeftVentricle", root)
    load = CavityPressure("endocardium", PRESSURE)
    return Problem("LeftVentricle", dataclasses.replace(scene, loads=(load,)), "endocardium")


def plate() -> Problem:
    """A small plate held at its sides, pressed from below: the same law, no released data."""
    mesh = box((10.0, 10.0, 2.0), (4, 4, 2))
    scene = Scene(
        name="pressed_plate",
        mesh=mesh,
        law=find_law("holzapfel_ogden_released"),
        parameters=(
            Parameter("a", "kPa", 0.1, 0.26, "log"),
            Parameter("b", "", 1.0, 4.2, "log"),
            Parameter("a_f", "kPa", 1.5, 5.18, "log"),
            Parameter("b_f", "", 1.0, 4.46, "log"),
        ),
        loads=(CavityPressure("bottom", PRESSURE),),
        supports=tuple(em.Support(side) for side in ("left", "right", "front", "back")),
        constants={"kappa": 25.0},
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
    )
    return Problem("plate", scene, "bottom")


def with_free_pressure(problem: Problem) -> Scene:
    """The scene with the pressure as its last parameter, 4 to 10 mmHg."""
    pressure = Parameter("pressure", "kPa", 4.0 * KPA_PER_MMHG, 10.0 * KPA_PER_MMHG)
    return dataclasses.replace(
        problem.scene,
        loads=(CavityPressure(problem.facet_set),),
        parameters=(*problem.scene.parameters, pressure),
    )


def arrays(problem: Problem) -> dict[str, Any]:
    """The problem as plain arrays, for the other codes."""
    scene = problem.scene
    return {
        "nodes": scene.mesh.nodes,
        "elements": scene.mesh.elements,
        "fibres": scene.fibres,
        "facets": scene.mesh.facet_set(problem.facet_set),
        "held": np.flatnonzero(scene.held.all(axis=1)),
        "pressure": PRESSURE,
        "kappa": scene.constants["kappa"],
    }


# ---- timing ----------------------------------------------------------------------------------
def first_call(function: Callable[..., Any], *arguments: Any) -> tuple[float, float]:
    """Seconds of the first call, and how many of them JAX spent compiling."""
    compiling = Compiling()
    seconds, _ = clocked(function, *arguments)
    return seconds, compiling.so_far()


def row(name: str, seconds: Iterable[float], converged: Iterable[bool], **more: Any) -> dict:
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


def ours_cold(simulator: em.Simulator, thetas: jax.Array) -> tuple[dict, np.ndarray]:
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


def ours_warm(simulator: em.Simulator, thetas: jax.Array) -> dict:
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


def wall_volume(scene: Scene, facet_set: str) -> Callable[[jax.Array], jax.Array]:
    """Displacement (n, 3) mm to the volume in mL between a facet set and lids on its openings.

    Unlike a cavity's it may be zero at rest: the slab's pressed face is flat.
    """
    facets = scene.mesh.facet_set(facet_set)
    volume: Callable[[jax.Array], jax.Array] = enclosed_volume(facets)
    return lambda u: volume(scene.mesh.nodes + u) / 1000.0


def ours_gradient(simulator: em.Simulator, facet_set: str, thetas: jax.Array) -> dict:
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
        [int(run[1][0][1]) == Status.CONVERGED for run in runs],
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


# ---- the others ------------------------------------------------------------------------------
def relative_difference(u: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference at any node, relative to the largest displacement, over all theta."""
    scale = np.abs(reference).max(axis=(1, 2))
    return float((np.abs(u - reference).max(axis=(1, 2)) / scale).max())


def plain(problem: Problem, thetas: jax.Array, reference: np.ndarray) -> dict:
    """scikit-fem and SciPy, in the number of load steps that needs the fewest iterations."""
    body = Body(**arrays(problem))
    spare = np.asarray(uniform(problem.scene, 3, jax.random.key(SEED + 2)))
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


def find_fenics(wanted: str | None) -> str | None:
    """An interpreter that imports dolfin, or ``None``."""
    for python in (wanted,) if wanted else ("/usr/bin/python3", "python3"):
        try:
            done = subprocess.run(
                [python, "-c", "import dolfin"], capture_output=True, env=_plain_environment()
            )
        except OSError:
            continue
        if done.returncode == 0:
            return python
    return None


def _plain_environment() -> dict[str, str]:
    """This process's environment without the variables of this Python."""
    ours = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    return {name: value for name, value in os.environ.items() if name not in ours}


def fenics(
    problem: Problem, thetas: jax.Array, reference: np.ndarray, python: str | None
) -> list[dict]:
    """FEniCS in its own process, its BLAS on one thread and on its default number."""
    found = find_fenics(python)
    if found is None:
        return [{"name": "FEniCS, cold", "status": "skipped: no interpreter with dolfin found"}]
    return [
        _fenics(f"FEniCS, cold, {words}", problem, thetas, reference, found, threads)
        for words, threads in (("1 BLAS thread", "1"), ("BLAS threads as it likes", None))
    ]


def _fenics(
    name: str,
    problem: Problem,
    thetas: jax.Array,
    reference: np.ndarray,
    python: str,
    threads: str | None,
) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        task, answer = Path(folder) / "problem.npz", Path(folder) / "solutions.npz"
        spare = uniform(problem.scene, 2, jax.random.key(SEED + 1))
        np.savez(task, **arrays(problem), warm_up=spare, theta=thetas[1:])
        # An empty cache of compiled forms, so that their compilation is timed.
        environment = {**_plain_environment(), "DIJITSO_CACHE_DIR": str(Path(folder) / "forms")}
        if threads is not None:
            environment |= {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        done = subprocess.run(
            [python, HERE / "fenics_ventricle.py", task, answer],
            capture_output=True,
            text=True,
            env=environment,
        )
        if done.returncode:
            return {"name": name, "status": "failed: " + done.stderr.strip().splitlines()[-1]}
        with np.load(answer, allow_pickle=False) as file:
            result = dict(file)
    volume = wall_volume(problem.scene, problem.facet_set)
    change = np.array([volume(u) for u in reference]) - float(volume(np.zeros_like(reference[0])))
    return row(
        name,
        result["seconds"],
        result["iterations"] > 0,
        iterations=float(np.median(result["iterations"])),
        compile_s=float(result["compile_seconds"]),
        linear_solver=str(result["linear_solver"]),
        version=str(result["version"]),
        difference=relative_difference(result["displacement"], reference),
        volume_difference=float(np.abs(result["volume_change"] / 1000.0 / change - 1.0).max()),
    )


# ---- the study -------------------------------------------------------------------------------
def compare(problem: Problem, count: int, python: str | None) -> list[dict]:
    """Ours, scikit-fem and FEniCS at ``count`` theta, after one that compiles."""
    scene, free_scene = problem.scene, with_free_pressure(problem)
    # New theta for each way of calling: factors of solved ones may be kept.
    cold, warm, slope = (
        uniform(body, count + 1, jax.random.key(SEED + number))
        for number, body in enumerate((scene, free_scene, free_scene), start=10)
    )
    case, reference = ours_cold(em.Simulator(scene), cold)
    free = em.Simulator(free_scene)
    cases = [
        case,
        ours_warm(free, warm),
        ours_gradient(free, problem.facet_set, slope),
        plain(problem, cold, reference),
        *fenics(problem, cold, reference, python),
    ]
    for case in cases:
        case["problem"] = problem.name
        case["nodes"] = len(scene.mesh.nodes)
        case["elements"] = len(scene.mesh.elements)
    return cases


def cube(cells: int) -> dict:
    """The twisting cube, in a process of its own."""
    failed = {"name": f"cube, {cells} cells an edge", "problem": "cube", "cells": cells}
    try:
        done = run("fem_speed.cube_case", cells, limit=LIMIT)
    except subprocess.TimeoutExpired:
        return {**failed, "status": f"stopped after {LIMIT:g} s"}
    if done.returncode:
        # A process killed for its memory prints nothing.
        reason = (done.stderr.strip().splitlines() or ["killed"])[-1]
        return {**failed, "status": f"failed: {reason}"}
    case = {**json.loads(done.stdout.splitlines()[-1]), "problem": "cube", "cells": cells}
    print(
        f"{case['name']:42s} {case['status']:12s} cold {case['cold_s']:8.3f} s   "
        f"peak {case['peak_gb']:.2f} GB",
        flush=True,
    )
    return case


def ratios(cases: list[dict]) -> dict[str, float]:
    """Times of the others from rest, as multiples of ours."""
    times = {case["name"]: case["median_s"] for case in cases if "median_s" in case}
    own = times["ours, cold"]
    found = {"scikit-fem": times["scikit-fem + SciPy, cold"] / own}
    rivals = [seconds for name, seconds in times.items() if name.startswith("FEniCS")]
    return found | ({"FEniCS": min(rivals) / own} if rivals else {})


def draw(cases: list[dict], path: Path) -> None:
    """Times of the pressurised body, and time and memory of the cubes against their size."""
    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.6), layout="constrained")
    bars = [case for case in cases if "median_s" in case]
    names = [case["name"] for case in bars]
    colours = ["tab:blue" if name.startswith("ours") else "0.6" for name in names]
    left.barh(names, [case["median_s"] for case in bars], color=colours)
    left.invert_yaxis()
    left.set(xscale="log", xlabel="median time of one call (s)", title=bars[0]["problem"])
    for k, case in enumerate(bars):
        left.annotate(f" {case['median_s']:.3g} s", (case["median_s"], k), va="center", fontsize=9)
    left.margins(x=0.15)
    cubes = [case for case in cases if "cold_s" in case]
    nodes = [case["nodes"] for case in cubes]
    right.plot(nodes, [case["cold_s"] for case in cubes], "o-", label="solve from rest (s)")
    right.plot(nodes, [case["compile_s"] for case in cubes], "^:", label="compilation (s)")
    right.plot(nodes, [case["peak_gb"] for case in cubes], "s--", label="peak memory (GB)")
    right.set(xscale="log", yscale="log", xlabel="nodes", title="twisting cube")
    right.grid(alpha=0.25)
    right.legend(frameon=False)
    save(figure, path)


def table(cases: list[dict]) -> str:
    """The README's tables."""
    lines = ["| | median | compilation, once | iterations |", "|---|---|---|---|"]
    for case in (case for case in cases if "median_s" in case):
        compiling = f"{case['compile_s']:.1f} s" if "compile_s" in case else "none"
        count = f"{case['iterations']:.0f}" if "iterations" in case else ""
        lines.append(f"| {case['name']} | {case['median_s']:.3f} s | {compiling} | {count} |")
    lines += [
        "",
        "| nodes | tetrahedra | from rest | compilation, once | iterations | peak memory |",
    ]
    lines.append("|---|---|---|---|---|---|")
    lines += [
        f"| {case['nodes']} | {case['elements']} | {case['cold_s']:.2f} s | "
        f"{case['compile_s']:.1f} s | {case['iterations']} | {case['peak_gb']:.2f} GB |"
        for case in cases
        if "cold_s" in case
    ]
    return "\n".join(lines)


def check(cases: list[dict]) -> None:
    """The claims of the study's README that do not depend on the machine."""
    for case in cases:
        skipped = case["status"].startswith("skipped")
        assert skipped or case["status"] == "converged", (case["name"], case["status"])
        assert case.get("difference", 0.0) <= 1e-6, case["name"]
        assert case.get("volume_difference", 0.0) <= 1e-6, case["name"]
        assert case.get("gradient_error", 0.0) <= 1e-4, case["name"]


def check_times(found: dict[str, float]) -> None:
    """The claims about time."""
    assert found["scikit-fem"] > 10.0
    assert found.get("FEniCS", 20.0) >= 20.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--published", type=Path, help="folder of the released data")
    parser.add_argument("--fenics-python", help="interpreter that has dolfin")
    parser.add_argument("--cases", type=int, default=16, help="theta a method is timed on")
    parser.add_argument("--quick", action="store_true", help="a small plate, two small cubes")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    if not arguments.quick and arguments.published is None:
        parser.error("give --published DIR, or --quick")
    problem = plate() if arguments.quick else ventricle(arguments.published)
    count = 3 if arguments.quick else arguments.cases
    cases = compare(problem, count, arguments.fenics_python)
    found = ratios(cases)
    cases += [cube(cells) for cells in ((3, 4) if arguments.quick else CUBES)]
    header = study_header(HERE, SEED)
    write_json(
        arguments.out / "results.json", {**header, "times_as_long_as_ours": found, "cases": cases}
    )
    draw(cases, arguments.out / "speed.png")
    print(table(cases))
    check(cases)
    if not arguments.quick:
        check_times(found)


if __name__ == "__main__":
    main()
