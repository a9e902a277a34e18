"""Large meshes: what grows, and what one machine can hold.

    python -m studies.large_meshes
    python -m studies.large_meshes --quick --out DIR

FEM of the ventricle at 5 to 100 thousand nodes, linear and quadratic tetrahedra, each mesh in a
process of its own: time of a solve from rest and of one from a neighbouring solution, iterations,
factorisations, peak memory, and what a tangent, a factorisation and a back-substitution take.
Beside them conjugate gradients with a kept factor, and with algebraic multigrid where pyamg is
installed. Then the whole way from a mesh of 50 000 nodes to a certified posterior,
command by command. Writes results.json after each case and meshes.png.
"""

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from studies.common.output import Case, Results, parser, save
from studies.common.processes import peak_gb, run
from studies.common.timing import clocked
from studies.mesh_to_certificate.__main__ import one as from_mesh_to_certificate

import emulator as em
from calibrate.figures import pyplot
from emulator.fem.assembly import System
from emulator.fem.linear.reuse import KeptFactor
from emulator.fem.linear.suitesparse import factor_and_solve
from emulator.fem.solution import Status
from emulator.scenes.scene import Scene

HERE = Path(__file__).parent
SEED = 0
# Order of the elements; rings, points around and layers.
MESHES = (
    (1, 24, 48, 4),
    (1, 38, 76, 7),
    (1, 52, 104, 10),
    (1, 65, 130, 13),
    (2, 12, 24, 2),
    (2, 18, 36, 4),
    (2, 26, 52, 5),
    (2, 34, 68, 6),
)
QUICK = ((1, 6, 12, 2), (2, 4, 8, 1))
POSTERIOR = (52, 104, 10)
LIMIT = 16.0  # GB that the largest linear mesh may take


def ventricle(order: int, rings: int, around: int, layers: int) -> Scene:
    """The built-in ventricle, its elements linear or quadratic."""
    return em.scenes.left_ventricle(rings, around, layers, order=order, grading=1.0)


def one(mesh: tuple[int, int, int, int]) -> dict[str, Any]:
    """All about one mesh."""
    making, scene = clocked(lambda: ventricle(*mesh))
    simulator = em.Simulator(scene)
    near = np.random.default_rng(SEED).uniform(0.4, 0.6, (2, len(scene.parameters)))
    centre, *others = (scene.from_unit(jnp.asarray(x)) for x in (np.full(5, 0.5), *near))
    cold, first = clocked(lambda: simulator.solve(centre))
    definite = simulator.system
    row = {
        "status": Status(int(first.status)).text,
        "nodes": len(scene.mesh.nodes),
        "elements": len(scene.mesh.elements),
        "unknowns": definite.pattern.size,
        "nonzeros": len(definite.pattern.rows),
        "scene_s": making,
        "first_solve_s": cold,
    }
    kept = definite.kept
    for name, theta, start in (
        ("from_rest", others[0], None),
        ("from_neighbour", others[1], first.displacement),
    ):
        before = kept.factorisations if kept else 0
        seconds, solution = clocked(lambda theta=theta, start=start: simulator.solve(theta, start))
        tangents = int(solution.factorisations)
        row[name] = {
            "seconds": seconds,
            "status": Status(int(solution.status)).text,
            "iterations": int(solution.iterations),
            "tangents": tangents,
            "factorisations": kept.factorisations - before if kept else tangents,
        }
    row["peak_GB"] = peak_gb()
    row |= parts(definite, first.displacement, centre)
    rest = row["from_rest"]
    row["share_of_factorisation"] = rest["factorisations"] * row["factor_s"] / rest["seconds"]
    return row


def parts(definite: System, u: jax.Array, theta: jax.Array) -> dict[str, Any]:
    """Seconds of a tangent, a factorisation and a back-substitution, and of two iterations."""
    definite.safe_tangent(u, theta, 1.0)
    tangent, (K, _) = clocked(lambda: definite.safe_tangent(u, 1.01 * theta, 1.0))
    b = jnp.asarray(np.random.default_rng(SEED).normal(size=definite.pattern.size))
    solve = jax.jit(partial(factor_and_solve, definite.pattern, kind="definite"))
    jax.block_until_ready(solve(K, b))
    other, _ = definite.safe_tangent(u, 1.02 * theta, 1.0)
    both, _ = clocked(lambda: solve(other, b))
    twice = jax.block_until_ready(2.0 * b)
    back, _ = clocked(lambda: solve(other, twice))
    beside = KeptFactor(definite.pattern)
    beside.attempt(K, b)
    beside.attempt(other, b)
    factors = beside.factorisations
    third, _ = definite.safe_tangent(u, theta * jnp.array([1.2, 1.1, 0.9, 1.1, 1.0]), 1.0)
    seconds, _ = clocked(lambda: beside.attempt(third, b))
    return {
        "tangent_s": tangent,
        "factor_s": both - back,
        "back_substitution_s": back,
        "beside_factor_s": seconds if beside.factorisations == factors else None,
        "multigrid": multigrid(definite, np.asarray(third), np.asarray(b)),
    }


def multigrid(definite: System, values: np.ndarray, b: np.ndarray) -> dict[str, Any] | None:
    """Smoothed aggregation that knows the rigid motions, before conjugate gradients."""
    try:
        import pyamg
    except ModuleNotFoundError:
        return None
    pattern = definite.pattern
    upper = sp.csr_matrix((values, (pattern.rows, pattern.columns)), (pattern.size,) * 2)
    matrix = (upper + sp.triu(upper, 1).T).tobsr((3, 3))
    X = definite.scene.mesh.nodes - definite.scene.mesh.nodes.mean(axis=0)
    turned = [np.cross(axis, X) for axis in np.eye(3)]
    moved = [np.broadcast_to(axis, X.shape) for axis in np.eye(3)]
    motions = np.stack([*moved, *turned], axis=-1).reshape(-1, 6)[definite.free]
    began = time.perf_counter()
    residuals: list[float] = []
    levels = pyamg.smoothed_aggregation_solver(
        matrix, B=motions, strength=("symmetric", {"theta": 0.0}), smooth="jacobi", max_coarse=500
    )
    ready = time.perf_counter()
    levels.solve(b, tol=1e-8, accel="cg", maxiter=300, residuals=residuals)
    return {
        "setup_s": ready - began,
        "solve_s": time.perf_counter() - ready,
        "iterations": len(residuals) - 1,
        "converged": bool(residuals[-1] <= 1e-8 * residuals[0]),
    }


def exponent(rows: list[dict[str, Any]], value: Callable[[dict[str, Any]], float]) -> float:
    """Slope of log value against log nodes."""
    x, y = np.log([row["nodes"] for row in rows]), np.log([value(row) for row in rows])
    return float(np.polyfit(x, y, 1)[0])


def summary(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Growth exponents by order of the elements."""
    found = {}
    for order in (1, 2):
        rows = [case for case in cases if case["order"] == order and "factor_s" in case]
        if len(rows) < 2:
            continue
        found[f"P{order}"] = {
            "from rest": exponent(rows, lambda r: r["from_rest"]["seconds"]),
            "from a neighbour": exponent(rows, lambda r: r["from_neighbour"]["seconds"]),
            "factorisation": exponent(rows, lambda r: r["factor_s"]),
            "back-substitution": exponent(rows, lambda r: r["back_substitution_s"]),
            "tangent": exponent(rows, lambda r: r["tangent_s"]),
            "peak memory": exponent(rows, lambda r: r["peak_GB"]),
        }
    return found


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Times and memory against nodes."""
    plt = pyplot()
    figure, both = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained")
    lines = {
        "solve from rest": (lambda r: r["from_rest"]["seconds"], "o", "#0072B2"),
        "solve from a neighbour": (lambda r: r["from_neighbour"]["seconds"], "s", "#009E73"),
        "factorisation": (lambda r: r["factor_s"], "^", "#D55E00"),
        "gradients beside a factor": (lambda r: r["beside_factor_s"], "v", "#CC79A7"),
        "gradients with multigrid": (
            lambda r: r["multigrid"] and r["multigrid"]["setup_s"] + r["multigrid"]["solve_s"],
            "d",
            "#56B4E9",
        ),
        "tangent": (lambda r: r["tangent_s"], "x", "black"),
    }
    for order, style in ((1, "-"), (2, "--")):
        rows = [case for case in cases if case["order"] == order]
        nodes = [row["nodes"] for row in rows]
        for name, (value, mark, colour) in lines.items():
            y = [np.nan if value(row) is None else value(row) for row in rows]
            label = name if order == 1 else None
            both[0].plot(nodes, y, style + mark, color=colour, mfc="none", label=label)
        memory = [row["peak_GB"] for row in rows]
        label = "linear" if order == 1 else "quadratic"
        both[1].plot(nodes, memory, style + "o", color="#0072B2", mfc="none", label=label)
    both[0].set(xlabel="nodes", ylabel="seconds", xscale="log", yscale="log")
    both[0].set_title("solid: linear, dashed: quadratic", fontsize="medium")
    both[1].set(xlabel="nodes", ylabel="peak memory, GB", xscale="log", yscale="log")
    for axes in both:
        axes.grid(color="0.9")
        axes.legend(frameon=False, fontsize="small")
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def measured(mesh: tuple[int, int, int, int]) -> Case:
    """:func:`one` in a process of its own, or how it ended."""
    done = run("large_meshes", "--mesh", *mesh)
    shape = {"order": mesh[0], "mesh": list(mesh[1:])}
    if done.returncode:
        return {"status": f"exit code {done.returncode}", **shape}
    return shape | json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Run the study."""
    arguments = parser(__doc__, HERE)
    arguments.add_argument("--mesh", type=int, nargs=4, help="measure this one, for the study")
    given = arguments.parse_args()
    if given.mesh is not None:
        print(json.dumps(one(tuple(given.mesh))))
        return
    results = Results(given.out, SEED, again=given.again, settings={"quick": given.quick})
    for mesh in QUICK if given.quick else MESHES:
        results.case(f"P{mesh[0]} {mesh[1:]}", lambda mesh=mesh: measured(mesh))
    if not given.quick:
        results.case("posterior", lambda: from_mesh_to_certificate("human", POSTERIOR))
    meshes = [case for case in results.cases if "from_rest" in case]
    results.write(summary=summary(meshes))
    draw(meshes, given.out / "meshes.png")
    assert all(case["status"] == "converged" for case in meshes)
    assert max(case["peak_GB"] for case in meshes if case["order"] == 1) < LIMIT


if __name__ == "__main__":
    main()
