"""What accuracy costs in time: every way from theta to displacements, on eight bodies.

    python -m studies.accuracy_vs_time               # two hours on 2 idle cores
    python -m studies.accuracy_vs_time --quick --out DIR
    python -m studies.accuracy_vs_time --only liver  # one part; stages that are there are kept

FEM, emulators, networks, reduced models and FEniCSx on the beam, the cube, the liver, the
ventricle, a ventricle of 21 656 nodes and the released bodies: their error, their time, and what
was done before. Then the posterior of the ventricle: its error against the time from mesh and data.
Writes results.json, references/, pareto.png, training.png, released.png and posteriors.png beside
itself.

``--published DIR`` names the released data, ``--fenics PYTHON`` (or CALIBRATE_FENICS) an
interpreter with FEniCSx; what needs them is skipped in one line without.
"""

import argparse
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from studies.accuracy_vs_time import fenics, posteriors
from studies.accuracy_vs_time.bodies import NAMES, find, is_released
from studies.accuracy_vs_time.figures import draw, draw_posteriors, draw_training, front
from studies.accuracy_vs_time.measure import measure, references
from studies.accuracy_vs_time.rungs import STAGES, Place
from studies.common.output import Case, Results, parser
from studies.common.processes import printed

HERE = Path(__file__).parent
SEED = 4
AGREED = 1e-6  # with FEniCSx, of the largest displacement or slope
SAMPLED = "posteriors"
PARTS = (*NAMES, SAMPLED)
ALL = (*STAGES, fenics.STAGE)
QUICK = ("from rest", "series", "discrepancy", "reduced", "shipped")


def of_body(results: Results, name: str, arguments: argparse.Namespace) -> None:
    """Every stage of a body that is not there, each in a process of its own."""
    if is_released(name) and arguments.published is None:
        print(f"{name}: skipped, no released data named (--published)")
        return
    there = {case["stage"] for case in results.cases if case.get("body") == name}
    body = find(name, arguments.published)
    everything = QUICK if arguments.quick else ALL
    asked = [s for s in arguments.stages or everything if s not in there and body.has(s)]
    if fenics.STAGE in asked and arguments.fenics is None:
        print(f"{name}: FEniCSx skipped, no interpreter named (--fenics, CALIBRATE_FENICS)")
        asked.remove(fenics.STAGE)
    words = ["--part", name, "--out", results.path.parent]
    words += ["--published", arguments.published] if arguments.published else []
    words += ["--fenics", arguments.fenics] if arguments.fenics else []
    words += ["--quick"] if arguments.quick else []
    # First the references, which are not timed; of a few cases all is one process.
    for stages in [asked] if arguments.quick else [[], *([stage] for stage in asked)]:
        told = [word for stage in stages for word in ("--stages", stage)]
        for case in printed("accuracy_vs_time", *words, *told, compiled=False) if asked else ():
            results.case(case["name"], lambda case=case: case)


def examine(name: str, arguments: argparse.Namespace) -> Iterator[Case]:
    """Cases of some stages of a body; the references alone where there are none."""
    body = find(name, arguments.published)
    place = Place(name, body, body.scene(), arguments.published, arguments.quick)
    known = references(place, arguments.out / "references")
    for stage in arguments.stages or ():
        if stage == fenics.STAGE:
            found = fenics.examine(place, known, arguments.fenics)
        else:
            found = (measure(rung, place, known) for rung in STAGES[stage](place))
        for case in found:
            about = {"name": f"{name}: {case['rung']}", "status": "done", "clock": "processor"}
            yield {**about, "body": name, "stage": stage, **case}


def table(cases: list[Case]) -> str:
    """A table of a body's rungs for the README."""
    rows = [
        "| rung | FEM runs | before | error, same mesh | error, fine mesh | value | + gradient |",
        "|---|---|---|---|---|---|---|",
    ]
    for c in cases:
        own, truth = (
            f"{c[key]['median']:.1e} mm" if c[key] else "" for key in ("own_mm", "truth_mm")
        )
        nodes = "" if c["own_mm"] else f" ({c['nodes']} nodes)"
        rows.append(
            f"| {c['rung']}{nodes} | {c['fem_runs']} | {c['offline_s']:.0f} s | {own} | "
            f"{truth} | {1e3 * c['value_s']:.3g} ms | "
            f"{1e3 * c['gradient_s']:.3g} ms |"
        )
    return "\n".join(rows)


def break_even(cases: list[Case]) -> dict[str, float]:
    """Values with gradient after which a rung and its preparation beat FEM from rest."""
    rest = next((c for c in cases if c["rung"] == "FEM from rest"), None)
    if rest is None:
        return {}
    return {
        c["rung"]: c["offline_s"] / (rest["gradient_s"] - c["gradient_s"])
        for c in cases
        if c["offline_s"] and c["gradient_s"] < rest["gradient_s"]
    }


def of(cases: list[Case], body: str) -> dict[str, Case]:
    """A body's cases by rung."""
    return {
        case["rung"]: case
        for case in cases
        if case.get("body") == body and case["status"] == "done"
    }


def check(cases: list[Case], *, quick: bool) -> None:
    """The README's claims, of the bodies that are complete enough for them."""
    for body in {case["body"] for case in cases if "body" in case}:
        check_body(of(cases, body), quick=quick)
    ways = {case["posterior"]: case for case in cases if "posterior" in case}
    sure = ways.get("series + discrepancy, 60 FEM runs, NUTS")
    assert sure is None or sure["largest_shift"] < 0.15


def check_body(found: dict[str, Case], *, quick: bool) -> None:
    """Fronts, Newton steps, emulators better than their mesh, and agreement with FEniCSx."""
    own = {name: case["own_mm"]["median"] for name, case in found.items() if case["own_mm"]}
    known = [case for case in found.values() if case["truth_mm"]]
    if known:
        best = front(np.array([(c["gradient_s"], c["truth_mm"]["median"]) for c in known]))
        assert (np.diff(best[:, 0]) >= 0.0).all()
        assert (np.diff(best[:, 1]) <= 0.0).all()
    assert own.get("FEM from rest", 0.0) < 1e-6
    for case in found.values():
        assert case.get("difference", 0.0) < AGREED, case["name"]
        assert case.get("gradient_difference", 0.0) < AGREED, case["name"]
    emulator, rest = found.get("emulator, full field"), found.get("FEM from rest")
    if "emulator + 2 Newton steps" in own:
        assert own["emulator + 2 Newton steps"] < max(1e-9, own["emulator, full field"])
    if emulator and rest and not quick:  # an emulator better than its mesh buys nothing
        if rest["truth_mm"]:
            assert own["emulator, full field"] < 0.1 * rest["truth_mm"]["median"]
        assert emulator["gradient_s"] < 0.1 * rest["gradient_s"]


def summary(cases: list[Case]) -> dict[str, Any]:
    """Break-even of every body."""
    bodies = dict.fromkeys(case["body"] for case in cases if "body" in case)
    return {body: break_even(list(of(cases, body).values())) for body in bodies}


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--only", nargs="+", choices=PARTS, help="parts to run")
    words.add_argument("--ways", nargs="+", choices=posteriors.WAYS, help="posteriors to draw")
    words.add_argument("--stages", action="append", choices=ALL, help="stages of bodies to run")
    words.add_argument("--published", type=Path, help="folder of the released data")
    words.add_argument(
        "--fenics", default=os.environ.get("CALIBRATE_FENICS"), help="interpreter with FEniCSx"
    )
    words.add_argument("--part", help="print one part's cases as JSON; for the study itself")
    arguments = words.parse_args()
    if arguments.part in NAMES:
        print(json.dumps(list(examine(arguments.part, arguments))))
        return
    if arguments.part:
        print(json.dumps(posteriors.examine(arguments.part)))
        return
    results = Results(
        arguments.out, SEED, again=arguments.again, settings={"quick": arguments.quick}
    )
    for name in arguments.only or (["beam"] if arguments.quick else PARTS):
        if name in NAMES:
            of_body(results, name, arguments)
            continue
        for way in arguments.ways or posteriors.WAYS:
            results.case(
                f"posterior: {way}",
                lambda way=way: printed("accuracy_vs_time", "--part", way, compiled=False),
            )
    tell(results, arguments.out)
    check(results.cases, quick=arguments.quick)


def tell(results: Results, out: Path) -> None:
    """Summary, tables and figures."""
    bodies = [case for case in results.cases if "body" in case and case["status"] == "done"]
    sampled = [case for case in results.cases if "posterior" in case]
    results.write(summary=summary(results.cases))
    for body in dict.fromkeys(case["body"] for case in bodies):
        print(f"\n{body}\n{table(list(of(bodies, body).values()))}")
    for path, of_release in (("pareto.png", False), ("released.png", True)):
        shown = [case for case in bodies if is_released(case["body"]) == of_release]
        if shown:
            draw(shown, out / path)
    built_in = [case for case in bodies if not is_released(case["body"])]
    if built_in:
        draw_training(built_in, out / "training.png")
    if sampled:
        draw_posteriors(sampled, out / "posteriors.png")


if __name__ == "__main__":
    main()
