"""One twisting cube, solved from rest in a process of its own, whose peak memory is measured.

    python cube_case.py CELLS

Prints one line of JSON.
"""

import json
import resource
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
from compiling import Compiling

import emulator as em
from emulator.fem import Status


def peak_gb() -> float:
    """Peak memory of this process.

    On Linux ``ru_maxrss`` begins at the value of the parent process; the kernel's high-water mark
    ``VmHWM`` starts afresh with the program.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(x for x in status.read_text().splitlines() if x.startswith("VmHWM"))
        kilobytes = int(line.split()[1])
    else:
        kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes * 1024 / 1e9


def timed_solve(simulator: em.Simulator, theta: jax.Array) -> tuple[float, em.Solution]:
    begin = time.perf_counter()
    solution = jax.block_until_ready(simulator.solve(theta))
    return time.perf_counter() - begin, solution


def main() -> None:
    cells = int(sys.argv[1])
    before, compiling = peak_gb(), Compiling()
    scene = em.scenes.twisting_cube(cells=cells)
    simulator = em.Simulator(scene)
    # A new theta: direct solvers keep factors of values they have seen.
    first, _ = timed_solve(simulator, scene.centre)
    after_one, compile_s = peak_gb(), compiling.so_far()
    seconds, solution = timed_solve(simulator, scene.centre * jnp.array([1.3, 0.9]))
    row = {
        "name": f"cube, {cells} cells an edge",
        "status": Status(int(solution.status)).text,
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
