"""What accuracy costs in time: every way from theta to displacements, on five bodies.

    python -m studies.accuracy_vs_time               # an hour on 2 idle cores
    python -m studies.accuracy_vs_time --quick --out DIR
    python -m studies.accuracy_vs_time --only liver  # one part; cases that are there are kept

FEM, emulators, networks and reduced models on the beam, the cube, the liver, the ventricle and a
ventricle of 20 000 nodes: their error, their time, and what was done before. Then the posterior of
the ventricle: its error against the time from mesh and data. Writes results.json, pareto.png and
posteriors.png beside itself.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from studies.accuracy_vs_time import posteriors
from studies.accuracy_vs_time.bodies import BODIES
from studies.accuracy_vs_time.figures import draw, draw_posteriors, front
from studies.accuracy_vs_time.rungs import examine
from studies.common.output import Case, Results, parser
from studies.common.processes import printed

HERE = Path(__file__).parent
SEED = 4
SAMPLED = "posteriors"
PARTS = (*BODIES, SAMPLED)


def of_body(results: Results, name: str, *, quick: bool) -> None:
    """All rungs of a body, in a process of their own."""
    if any(case.get("body") == name for case in results.cases):
        return
    words = ["--quick"] if quick else []
    for case in printed("accuracy_vs_time", "--part", name, *words, compiled=False):
        results.case(case["name"], lambda case=case: case)


def table(cases: list[Case]) -> str:
    """A table of a body's rungs for the README."""
    rows = [
        "| rung | FEM runs | before | error, same mesh | error, fine mesh | value | + gradient |",
        "|---|---|---|---|---|---|---|",
    ]
    for c in cases:
        own = f"{c['own_mm']['median']:.1e} mm" if c["own_mm"] else ""
        nodes = "" if c["own_mm"] else f" ({c['nodes']} nodes)"
        rows.append(
            f"| {c['rung']}{nodes} | {c['fem_runs']} | {c['offline_s']:.0f} s | {own} | "
            f"{c['truth_mm']['median']:.1e} mm | {1e3 * c['value_s']:.3g} ms | "
            f"{1e3 * c['gradient_s']:.3g} ms |"
        )
    return "\n".join(rows)


def break_even(cases: list[Case]) -> dict[str, float]:
    """Values with gradient after which a rung and its preparation beat FEM from rest."""
    rest = next(c for c in cases if c["rung"] == "FEM from rest")
    return {
        c["rung"]: c["offline_s"] / (rest["gradient_s"] - c["gradient_s"])
        for c in cases
        if c["offline_s"] and c["gradient_s"] < rest["gradient_s"]
    }


def of(cases: list[Case], body: str) -> dict[str, Case]:
    """A body's cases by rung."""
    return {case["rung"]: case for case in cases if case.get("body") == body}


def check(cases: list[Case], *, quick: bool) -> None:
    """The README's claims."""
    for body in {case["body"] for case in cases if "body" in case}:
        found = of(cases, body)
        own = {n: c["own_mm"]["median"] for n, c in found.items() if c["own_mm"]}
        assert own["FEM from rest"] < 1e-6, body
        assert own["emulator + 2 Newton steps"] < max(1e-9, own["emulator, full field"]), body
        best = front(np.array([(c["gradient_s"], c["truth_mm"]["median"]) for c in found.values()]))
        assert (np.diff(best[:, 0]) >= 0.0).all(), body
        assert (np.diff(best[:, 1]) <= 0.0).all(), body
        if quick:
            continue
        # An emulator better than its mesh buys nothing.
        emulator, mesh = found["emulator, full field"], found["FEM from rest"]["truth_mm"]["median"]
        assert emulator["own_mm"]["median"] < 0.1 * mesh, body
        assert emulator["gradient_s"] < 0.1 * found["FEM from rest"]["gradient_s"], body
    ways = {case["posterior"]: case for case in cases if "posterior" in case}
    sure = ways.get("series + discrepancy, 60 FEM runs, NUTS")
    assert sure is None or sure["largest_shift"] < 0.15


def summary(cases: list[Case]) -> dict[str, Any]:
    """Break-even of every body."""
    bodies = dict.fromkeys(case["body"] for case in cases if "body" in case)
    return {body: break_even(list(of(cases, body).values())) for body in bodies}


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--only", nargs="+", choices=PARTS, help="parts to run")
    words.add_argument("--part", help="print one part's cases as JSON; for the study itself")
    arguments = words.parse_args()
    if arguments.part in BODIES:
        print(json.dumps(list(examine(arguments.part, quick=arguments.quick))))
        return
    if arguments.part:
        print(json.dumps(posteriors.examine(arguments.part)))
        return
    results = Results(
        arguments.out, SEED, again=arguments.again, settings={"quick": arguments.quick}
    )
    parts = arguments.only or (["beam"] if arguments.quick else PARTS)
    for name in parts:
        if name in BODIES:
            of_body(results, name, quick=arguments.quick)
            continue
        for way in posteriors.WAYS:
            results.case(
                f"posterior: {way}",
                lambda way=way: printed("accuracy_vs_time", "--part", way, compiled=False),
            )
    bodies = [case for case in results.cases if "body" in case]
    sampled = [case for case in results.cases if "posterior" in case]
    results.write(summary=summary(results.cases))
    for body in dict.fromkeys(case["body"] for case in bodies):
        print(f"\n{body}\n{table(list(of(bodies, body).values()))}")
    draw(bodies, arguments.out / "pareto.png")
    if sampled:
        draw_posteriors(sampled, arguments.out / "posteriors.png")
    check(results.cases, quick=arguments.quick)


if __name__ == "__main__":
    main()
