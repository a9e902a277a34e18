"""A thousand ventricle solves from rest in one process: success, leaks, hangs.

``python -m studies.many_solves [--published DIR] [--solves N]``. Writes results.json and
many_solves.png beside itself, or under --out, and asserts what the README says.
"""

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from studies.common.output import save, study_header

import emulator as em
from calibrate.figures import pyplot
from emulator.core.store import write_json
from emulator.fem import uniform
from emulator.released.scenes import published_scene
from emulator.scenes import Parameter, Scene
from emulator.scenes.loads import CavityPressure

HERE = Path(__file__).parent
SEED = 11
SLOW = 60.0  # s; a solve that takes longer counts as hung
MMHG = 0.133322  # kPa


def ventricle(published: str | None) -> Scene:
    """The built-in ventricle, or the released one under exact pressure; 4 to 10 mmHg both."""
    if published is None:
        return em.scenes.left_ventricle(order=1)
    released = published_scene("LeftVentricle", published)
    pressure = Parameter("pressure", "kPa", 4.0 * MMHG, 10.0 * MMHG)
    return replace(
        released,
        name="published:LeftVentricle, exact pressure",
        parameters=(*released.parameters, pressure),
        loads=(CavityPressure("endocardium"),),
    )


def resident() -> float:
    """Resident memory of this process, MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024.0
    raise RuntimeError("no VmRSS in /proc/self/status")


def solve_all(scene: Scene, count: int) -> list[dict[str, Any]]:
    """One case for each solve, with the memory after it."""
    simulator = em.Simulator(scene)
    thetas = uniform(scene, count, jax.random.key(SEED))
    jax.block_until_ready(simulator.solve(scene.centre))  # compilation
    cases = []
    for number, theta in enumerate(thetas):
        begin = time.perf_counter()
        solution = jax.block_until_ready(simulator.solve(theta))
        seconds = time.perf_counter() - begin
        cases.append(
            {
                "name": f"theta {number}",
                "status": em.Status(int(solution.status)).name.lower(),
                "theta": [float(value) for value in theta],
                "iterations": int(solution.iterations),
                "factorisations": int(solution.factorisations),
                "residual": float(solution.residual),
                "load_reached": float(solution.load_reached),
                "time_s": seconds,
                "memory_mb": resident(),
            }
        )
        if (number + 1) % 50 == 0:
            failed = sum(case["status"] != "converged" for case in cases)
            print(
                f"{number + 1} solves, {failed} failed, {cases[-1]['memory_mb']:.0f} MB", flush=True
            )
    return cases


def summary(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Success rate, times, and the growth of memory over the second half of the run."""
    times = np.array([case["time_s"] for case in cases])
    memory = np.array([case["memory_mb"] for case in cases])
    later = np.arange(len(memory)) >= len(memory) // 2
    growth = np.polyfit(np.flatnonzero(later), memory[later], 1)[0] if later.sum() > 2 else 0.0
    return {
        "solves": len(cases),
        "statuses": dict(Counter(case["status"] for case in cases)),
        "success": float(np.mean([case["status"] == "converged" for case in cases])),
        "hung": int((times > SLOW).sum()),
        "time_s": {"median": float(np.median(times)), "max": float(times.max())},
        "factorisations": float(np.mean([case["factorisations"] for case in cases])),
        "memory_mb": {"first": float(memory[0]), "last": float(memory[-1])},
        "growth_mb_per_1000": 1000.0 * float(growth),
    }


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Time and memory against the number of the solve."""
    plt = pyplot()
    figure, (above, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
    times = np.array([case["time_s"] for case in cases])
    failed = np.array([case["status"] != "converged" for case in cases])
    above.semilogy(np.flatnonzero(~failed), times[~failed], ".", ms=3, label="converged")
    if failed.any():
        above.semilogy(np.flatnonzero(failed), times[failed], "x", color="C3", label="failed")
    above.set_ylabel("time of a solve in s")
    above.legend()
    below.plot([case["memory_mb"] for case in cases])
    below.set_ylim(bottom=0.0)
    below.set_ylabel("memory held in MB")
    below.set_xlabel("solve")
    save(figure, path, 150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--published", metavar="DIR", help="solve the released ventricle instead")
    parser.add_argument("--solves", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    scene = ventricle(arguments.published)
    cases = solve_all(scene, arguments.solves)
    found = summary(cases)
    print(found)
    arguments.out.mkdir(parents=True, exist_ok=True)
    header = {**study_header(HERE, SEED), "scene": scene.name, "summary": found}
    write_json(arguments.out / "results.json", {**header, "cases": cases})
    draw(cases, arguments.out / "many_solves.png")
    assert found["success"] >= 0.995, found["statuses"]
    assert found["hung"] == 0
    assert found["growth_mb_per_1000"] <= 100.0 or len(cases) < 200


if __name__ == "__main__":
    main()
