"""One twisting cube, solved from rest in a process of its own, whose peak memory is measured.

    python -m studies.fem_speed.cube_case CELLS

Prints one line of JSON.
"""

import json
import sys

import jax.numpy as jnp
from studies.common.compiling import Compiling
from studies.common.processes import peak_gb
from studies.common.timing import clocked

import emulator as em


def main() -> None:
    cells = int(sys.argv[1])
    before, compiling = peak_gb(), Compiling()
    scene = em.scenes.twisting_cube(cells=cells, order=1)
    simulator = em.Simulator(scene)
    # A new theta: direct solvers keep factors of values they have seen.
    first, _ = clocked(simulator.solve, scene.centre)
    after_one, compile_s = peak_gb(), compiling.so_far()
    seconds, solution = clocked(simulator.solve, scene.centre * jnp.array([1.3, 0.9]))
    row = {
        "name": f"cube, {cells} cells an edge",
        "status": em.fem.Status(int(solution.status)).text,
        "nodes": len(scene.mesh.nodes),
        "elements": len(scene.mesh.elements),
        "iterations": int(solution.iterations),
        "residual": float(solution.residual),
        "cold_s": seconds,
        "first_call_s": first,
        "compile_s": compile_s,
        "peak_gb": peak_gb(),
        "peak_after_one_gb": after_one,
        "peak_before_gb": before,
    }
    print(json.dumps(row))


if __name__ == "__main__":
    main()
