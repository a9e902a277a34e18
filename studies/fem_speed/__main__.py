"""How fast the finite elements are: against other codes, by size, and where the time goes.

    python -m studies.fem_speed --published DIR [--fenics PYTHON] [--peers PYTHON]
    python -m studies.fem_speed --quick --out DIR    # a small plate, a small beam, two small cubes

Writes results.json and speed.png, and asserts what the README of the study says. FEniCSx is
skipped where ``--fenics`` (or CALIBRATE_FENICS) names no interpreter that has it, torch-fem and
FElupe where ``--peers`` (or CALIBRATE_PEERS) names none.
"""

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

from studies.common.output import Case, Results, parser
from studies.common.processes import run
from studies.fem_speed import increments, peers, where
from studies.fem_speed.codes import SEED, compare
from studies.fem_speed.figures import draw, tables
from studies.fem_speed.problems import plate, ventricle

import emulator as em

HERE = Path(__file__).parent
CUBES = (6, 9, 13, 19, 27)
LIMIT = 900.0  # seconds for one cube
FINE = "ventricle, finer"
BODIES: dict[str, Callable[[], em.Scene]] = {
    "beam, linear": lambda: em.scenes.once_clamped_beam(order=1),
    "beam": em.scenes.once_clamped_beam,
    "ventricle, linear": lambda: em.scenes.left_ventricle(order=1),
    "ventricle": em.scenes.left_ventricle,
    FINE: lambda: em.scenes.left_ventricle(15, 30, 3),
}
ALIKE = {
    **{name: make for name, make in BODIES.items() if name != FINE},
    "cube": em.scenes.twisting_cube,
    "liver": em.scenes.liver,
}
QUICK = {"beam, coarse": lambda: em.scenes.once_clamped_beam((4, 1, 1), order=1)}


def cube(cells: int) -> Case:
    """The twisting cube, in a process of its own."""
    try:
        done = run("fem_speed.cube_case", cells, limit=LIMIT)
    except subprocess.TimeoutExpired:
        return {"cells": cells, "status": f"stopped after {LIMIT:g} s"}
    if done.returncode:
        # A process killed for its memory prints nothing.
        reason = (done.stderr.strip().splitlines() or ["killed"])[-1]
        return {"cells": cells, "status": f"failed: {reason}"}
    return {**json.loads(done.stdout.splitlines()[-1]), "cells": cells}


def check(cases: list[Case], *, quick: bool) -> None:
    """The claims of the study's README; those about time only in full."""
    for case in cases:
        assert case["status"] in ("converged", "done"), (case["name"], case["status"])
        assert case.get("difference", 0.0) <= 1e-6, case["name"]
        assert case.get("gradient_error", 0.0) <= 1e-4, case["name"]
        theirs = [case[code] for code in peers.PROGRAMS if code in case]
        assert all(code["difference"] <= 1e-6 for code in theirs), case["name"]
        if "thetas" in case:
            assert case["converged"] == case["same_iterations"] == case["thetas"], case["name"]
            assert case["largest_difference"] < 1e-12, case["name"]
    if quick:
        return
    found = {case["name"]: case for case in cases}
    ours, plain = found["ours, cold"], found["scikit-fem + SciPy, cold"]
    assert plain["median_s"] > 10.0 * ours["median_s"]
    for case in cases:
        assert case.get("times_as_long", 1.0) > 0.8, case["name"]
        assert case.get("jit_s", 0.0) <= 1.2 * case.get("python_s", 0.0), case["name"]


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--published", type=Path, help="folder of the released data")
    words.add_argument(
        "--fenics", default=os.environ.get("CALIBRATE_FENICS"), help="interpreter with FEniCSx"
    )
    words.add_argument(
        "--peers", default=os.environ.get("CALIBRATE_PEERS"), help="with torch-fem and FElupe"
    )
    words.add_argument("--cases", type=int, default=16, help="theta a method is timed on")
    arguments = words.parse_args()
    if not arguments.quick and arguments.published is None:
        words.error("give --published DIR, or --quick")
    quick = arguments.quick
    results = Results(arguments.out, SEED, again=arguments.again, settings={"quick": quick})
    problem = plate() if quick else ventricle(arguments.published)
    if "ours, cold" not in {case["name"] for case in results.cases}:
        for case in compare(problem, 3 if quick else arguments.cases):
            results.case(case["name"], lambda case=case: case)
    for name, make in (QUICK if quick else BODIES).items():
        few = 3 if quick or name == FINE else 9
        results.case(f"{name}, from rest", lambda make=make, few=few: where.of_body(make(), few))
        if arguments.fenics and name != FINE:
            results.case(
                f"{name}, beside FEniCSx",
                lambda make=make: where.beside_fenicsx(make(), 6, arguments.fenics),
            )
    for name, make in (QUICK if quick else ALIKE).items():
        many = 3 if quick else 60
        results.case(
            f"{name}, Python and jit", lambda make=make, many=many: where.parity(make(), many)
        )
    if not arguments.fenics:
        print("FEniCSx skipped, no interpreter named (--fenics, CALIBRATE_FENICS)")
    if not arguments.peers:
        print("torch-fem and FElupe skipped, no interpreter named (--peers, CALIBRATE_PEERS)")
    beams = (peers.QUICK if quick else peers.BEAMS) if arguments.peers else {}
    for name, (shape, order) in beams.items():
        results.case(
            f"beam, {name}",
            lambda shape=shape, order=order: peers.beside(shape, order, arguments.peers),
        )
    cells = (6, 4, 2) if quick else increments.CELLS
    results.case("ten increments", lambda: increments.measured(cells))
    for edge in (3, 4) if quick else CUBES:
        results.case(f"cube, {edge} cells an edge", lambda edge=edge: cube(edge))
    draw(results.cases, arguments.out / "speed.png")
    print(tables(results.cases))
    check(results.cases, quick=quick)


if __name__ == "__main__":
    main()
