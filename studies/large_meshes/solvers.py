"""One tangent of the ventricle, solved by CHOLMOD and by PETSc in several ways.

    python -m studies.large_meshes.solvers MATRIX.npz SOLVER

A process of its own for each: it reads the tangent of a body at rest, factorises it, factorises
another of the same pattern, and solves. Seconds of the processor, which other work on the machine
does not change, and of the clock; peak memory.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from studies.common.output import Case, Results
from studies.common.processes import peak_gb, run

from emulator.core.errors import InputError
from emulator.fem.assembly import System
from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.petsc import Factor, petsc_module
from emulator.fem.linear.suitesparse import SUITESPARSE, free_factors
from emulator.scenes.scene import Scene

# PETSC_OPTIONS of MUMPS: as it is, factors on disk, and block low-rank factors to six digits with
# iterations beside them.
OPTIONS = {
    "MUMPS": "",
    "MUMPS, on disk": "-mat_mumps_icntl_22 1",
    "MUMPS, low rank": "-mat_mumps_icntl_35 2 -mat_mumps_cntl_7 1e-6 "
    "-ksp_type fgmres -ksp_rtol 1e-10",
}
MULTIGRID = "-ksp_type cg -ksp_rtol 1e-8 -pc_type gamg"
SOLVERS = ("CHOLMOD", *OPTIONS, "multigrid (GAMG)")
SEED = 0


def store(scene: Scene, path: Path) -> Case:
    """Write two tangents at rest, a right-hand side and the rigid motions."""
    system, rest = System(scene), jnp.zeros(scene.held.shape)
    tangents = [system.safe_tangent(rest, k * scene.centre, 0.0)[0] for k in (1.0, 1.02)]
    X = scene.mesh.nodes - scene.mesh.nodes.mean(axis=0)
    turned = [np.cross(axis, X) for axis in np.eye(3)]
    moved = [np.broadcast_to(axis, X.shape) for axis in np.eye(3)]
    np.savez(
        path,
        rows=system.pattern.rows,
        columns=system.pattern.columns,
        first=tangents[0],
        second=tangents[1],
        b=np.random.default_rng(SEED).normal(size=system.pattern.size),
        motions=np.stack([*moved, *turned], axis=-1).reshape(-1, 6)[system.free],
    )
    return {"nodes": len(scene.mesh.nodes), "unknowns": system.pattern.size}


def both_times(function: Callable[..., Any], *arguments: Any) -> tuple[dict[str, float], Any]:
    """Seconds of the processor and of the clock that a call takes, and what it gave."""
    processor, clock = time.process_time(), time.perf_counter()
    result = function(*arguments)
    ended = time.process_time() - processor, time.perf_counter() - clock
    return dict(zip(("processor_s", "clock_s"), ended, strict=True)), result


def factorised(solver: str, matrix: Any, pattern: Pattern) -> Case:
    """With a factorisation: the first, which analyses the pattern, the second, and a solution."""
    b = np.asarray(matrix["b"])
    if solver in OPTIONS:
        factor = Factor(pattern)
        first, _ = both_times(factor.factorise, matrix["first"])
        second, _ = both_times(factor.factorise, matrix["second"])
        solution, x = both_times(factor.solve, b)
        row = {"iterations": factor._ksp.getIterationNumber()}
    else:
        free_factors()
        solve = jax.jit(lambda values, b: SUITESPARSE.solve(pattern, values, b, "definite")[0])
        with_solution = lambda *given: np.asarray(solve(*given))  # noqa: E731
        first, _ = both_times(with_solution, matrix["first"], b)
        second, _ = both_times(with_solution, matrix["second"], b)
        solution, x = both_times(with_solution, matrix["second"], 2.0 * b)
        x, row = 0.5 * x, {}
    residual = pattern.product(jnp.asarray(matrix["second"]), jnp.asarray(x)) - b
    row["residual"] = float(np.linalg.norm(residual) / np.linalg.norm(b))
    return {"first": first, "factorisation": second, "solution": solution, **row}


def multigrid(matrix: Any, pattern: Pattern) -> Case:
    """Smoothed aggregation that knows the rigid motions, before conjugate gradients."""
    PETSc = petsc_module()
    values, size = matrix["second"], pattern.size
    upper = sp.csr_matrix((values, (pattern.rows, pattern.columns)), (size, size))
    full = (upper + sp.triu(upper, 1).T).tocsr()
    A = PETSc.Mat().createAIJ((size, size), bsize=3, csr=(full.indptr, full.indices, full.data))
    near = [PETSc.Vec().createWithArray(q.copy()) for q in np.linalg.qr(matrix["motions"])[0].T]
    A.setNearNullSpace(PETSc.NullSpace().create(vectors=near))
    ksp = PETSc.KSP().create()
    ksp.setOperators(A)
    ksp.setFromOptions()
    b = PETSc.Vec().createWithArray(np.asarray(matrix["b"]))
    x = b.duplicate()
    setup, _ = both_times(ksp.setUp)
    solution, _ = both_times(ksp.solve, b, x)
    residual = full @ x.getArray() - matrix["b"]
    return {
        "factorisation": setup,
        "solution": solution,
        "iterations": ksp.getIterationNumber(),
        "residual": float(np.linalg.norm(residual) / np.linalg.norm(matrix["b"])),
    }


def one(path: Path, solver: str) -> Case:
    """All about one solver and one matrix."""
    os.environ["PETSC_OPTIONS"] = OPTIONS.get(solver, MULTIGRID)
    matrix = dict(np.load(path))
    none = np.zeros(0, np.int32)
    pattern = Pattern(matrix["rows"], matrix["columns"], none, none, len(matrix["b"]), upper=True)
    if solver != "CHOLMOD":
        petsc_module()
    row = {"before_GB": peak_gb()}
    found = (
        factorised(solver, matrix, pattern) if solver != SOLVERS[-1] else multigrid(matrix, pattern)
    )
    return row | found | {"peak_GB": peak_gb()}


def there() -> tuple[str, ...]:
    """The solvers that are installed."""
    try:
        petsc_module()
    except InputError:
        return SOLVERS[:1]
    return SOLVERS


def measure(results: Results, name: str, make: Callable[[], Scene]) -> None:
    """A case for each solver, in a process of its own, of the tangent of one scene."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "matrix.npz"
        size = cache(lambda: store(make(), path))
        for solver in there():
            results.case(f"{solver}, {name}", lambda solver=solver: measured(size(), path, solver))


def measured(size: Case, path: Path, solver: str) -> Case:
    """:func:`one` in a process of its own, or how it ended."""
    done = run("large_meshes.solvers", path, solver)
    if done.returncode:
        return {"status": f"exit code {done.returncode}", "solver": solver, **size}
    return {"solver": solver, **size, **json.loads(done.stdout.splitlines()[-1])}


if __name__ == "__main__":
    print(json.dumps(one(Path(sys.argv[1]), sys.argv[2])))
