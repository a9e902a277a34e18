"""What an evaluation of a cached emulator costs: against FEM, and by size of mesh.

    python -m studies.decoder_speed
    python -m studies.decoder_speed --quick --out DIR    # few calls, two small cubes

Writes results.json and decoder_speed.png, and asserts what the README of the study says.
"""

import argparse
from pathlib import Path
from typing import Any

from studies.common.output import save, study_header
from studies.decoder_speed import cubes, ventricle

from calibrate.figures import pyplot
from emulator.core.store import write_json

HERE = Path(__file__).parent
SEED = 11
BATCH = 256
ORDER = 3  # of the cubes' series


def summary(cases: list[dict[str, Any]]) -> dict[str, float]:
    """The numbers with a target: milliseconds, speed-up over FEM, growth with the mesh."""
    emulator = next(case for case in cases if case["name"] == "emulator")
    sizes = [case for case in cases if "landmarks_loop_s" in case]
    first, last = sizes[0], sizes[-1]
    return {
        "value_and_gradient_ms": 1e3 * emulator["call_s"],
        "times_faster_than_fem": emulator["times_faster_than_fem"],
        "batch_ms_a_theta": 1e3 * emulator["batch_s"],
        "landmarks_growth": last["landmarks_loop_s"] / first["landmarks_loop_s"],
        "landmarks_growth_of_calls": last["landmarks_call_s"] / first["landmarks_call_s"],
        "field_growth": last["field_loop_s"] / first["field_loop_s"],
    }


def _wrapped(name: str) -> str:
    """A method's name on two lines."""
    return name.replace(", ", ",\n").replace(" + 1 ", " +\n1 ")


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Left, each method's value and gradient on the ventricle; right, time against mesh size."""
    plt = pyplot()
    figure, (bars, lines) = plt.subplots(1, 2, figsize=(12, 4.4), layout="constrained")
    methods = [case for case in cases if "times_faster_than_fem" in case]
    for key, colour, label in (
        ("call_s", "tab:blue", "one call from Python"),
        ("loop_s", "tab:orange", "in a compiled loop"),
        ("batch_s", "tab:green", f"in a batch of {BATCH}"),
    ):
        known = [(k, 1e3 * case[key]) for k, case in enumerate(methods) if case[key] is not None]
        bars.plot(*zip(*known, strict=True), "o", color=colour, ms=8, label=label)
    bars.set_xticks(range(len(methods)), [_wrapped(case["name"]) for case in methods])
    bars.set(yscale="log", ylabel="value and gradient, a theta (ms)", xlim=(-0.5, 3.5))
    bars.set_title("left ventricle, 24 landmarks and cavity volume")
    sizes = [case for case in cases if "landmarks_loop_s" in case]
    nodes = [case["nodes"] for case in sizes]
    for key, style, label in (
        ("field_call_s", "s--", "full field, one call"),
        ("field_loop_s", "s-", "full field, in a loop"),
        ("field_batch_s", "s:", f"full field, in a batch of {BATCH}"),
        ("landmarks_loop_s", "o-", "24 landmarks, value and gradient, in a loop"),
    ):
        lines.plot(nodes, [1e3 * case[key] for case in sizes], style, label=label)
    lines.set(xscale="log", yscale="log", xlabel="nodes", ylabel="a theta (ms)")
    lines.set_title("twisting cube, one thing observed on every mesh")
    for axes in (bars, lines):
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8, frameon=False)
    save(figure, path)


def check(cases: list[dict[str, Any]]) -> None:
    """Assert that all methods were timed on the same quantity."""
    by_name = {case["name"]: case for case in cases}
    assert by_name["emulator"]["gradient_gap"] < 0.02
    assert by_name["emulator + 1 Newton step"]["gradient_gap"] < 0.02
    for case in cases:
        assert case.get("largest_gap_mm", 0.0) < 1e-9, case["name"]


def check_times(found: dict[str, float]) -> None:
    """The claims of the study's README."""
    assert found["value_and_gradient_ms"] <= 0.4
    assert found["times_faster_than_fem"] >= 300.0
    assert found["landmarks_growth"] < 1.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=400, help="timed calls of a fast map")
    parser.add_argument("--fem-calls", type=int, default=12, help="timed FEM gradients")
    parser.add_argument("--runs", type=int, default=30, help="FEM runs of the reduced model")
    parser.add_argument("--cells", type=int, nargs="+", default=[6, 9, 13, 19, 27])
    parser.add_argument("--quick", action="store_true", help="few calls, two small cubes")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    calls, fem_calls, runs = arguments.calls, arguments.fem_calls, arguments.runs
    cells, order = arguments.cells, ORDER
    if arguments.quick:
        calls, fem_calls, runs, cells, order = 20, 2, 5, [2, 3], 1
    cases = ventricle.study(calls, fem_calls, runs, BATCH, SEED)
    cases += cubes.study(cells, order, max(calls // 10, 2), BATCH, SEED)
    found = summary(cases)
    print("   ".join(f"{name} {value:.4g}" for name, value in found.items()), flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(
        arguments.out / "results.json",
        {**study_header(HERE, SEED), "cases": cases, "summary": found},
    )
    draw(cases, arguments.out / "decoder_speed.png")
    check(cases)
    if not arguments.quick:
        check_times(found)


if __name__ == "__main__":
    main()
