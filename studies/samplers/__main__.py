"""Which sampler, how fast, and do they agree? Twelve posteriors of emulators, five samplers.

    python -m studies.samplers                    # an hour of one core
    python -m studies.samplers --quick --out DIR  # a beam, few draws
    python -m studies.samplers --only "one volume" beam
    python -m studies.samplers --without "BlackJAX's nested sampling"

Each posterior is a process. Writes results.json and samplers.png, and asserts what the README says.
"""

import json
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.output import Case, Results, parser, save
from studies.common.processes import printed
from studies.samplers.problems import BODIES, OBSERVED, PROBLEMS, problem
from studies.samplers.ways import Moments, effective, gradient_s, moments, reference, timed, ways

from calibrate.figures import BLUE, GREEN, ORANGE, VERMILION, pyplot
from emulator.core.errors import SolverError

HERE = Path(__file__).parent
SEED = 11
COLOURS = {
    "importance": BLUE,
    "nuts": GREEN,
    "NumPyro's NUTS": ORANGE,
    "BlackJAX's NUTS": VERMILION,
    "BlackJAX's nested sampling": "0.5",
}
OURS = ("importance", "nuts")


def distance(found: Moments, exact: Moments) -> dict[str, float]:
    """Return the largest differences of a mean and of an sd, over their standard errors."""
    return {
        key: float(
            np.max(
                np.abs(getattr(found, key) - getattr(exact, key))
                / np.hypot(getattr(found, f"{key}_error"), getattr(exact, f"{key}_error"))
            )
        )
        for key in ("mean", "sd")
    }


def examine(name: str, draws: int, points: int, without: Collection[str] = ()) -> Case:
    """One posterior: every sampler's rate, and how far ours are from the reference."""
    model, data = problem(name, SEED)
    rows: dict[str, Any] = {}
    found = {}
    for way, draw in ways(model, data, draws).items():
        if way in without:
            continue
        try:
            found[way], seconds = timed(draw, SEED)
        except SolverError as failure:  # importance sampling says so, and `auto` takes NUTS
            print(f"{name}, {way}: {failure}", file=sys.stderr, flush=True)
            continue
        print(f"{name}, {way}: {seconds:.1f} s", file=sys.stderr, flush=True)
        rows[way] = {"ess": round(effective(found[way]), 1), "processor_s": round(seconds, 3)}
    exact = reference(model, data, found["nuts"].draws, points)
    for way, drawn in found.items():
        rows[way]["z"] = distance(moments(drawn), exact)
    error = float(np.max(exact.mean_error / exact.sd))
    return {
        "unknowns": len(model.names),
        "gradient_s": gradient_s(model, data),
        "reference_error": error,
        "samplers": rows,
    }


def rate(case: Case, way: str) -> float:
    """Effective draws of the slowest unknown by processor second; NaN where it was left out."""
    if way not in case["samplers"]:
        return float("nan")
    row = case["samplers"][way]
    return row["ess"] / max(row["processor_s"], 1e-3)


def table(cases: list[Case]) -> str:
    """Return the table of the README."""
    heads = [
        "effective draws a second",
        "unknowns",
        "gradient",
        *COLOURS,
        "z of importance",
        "z of nuts",
    ]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for case in cases:
        values = [rate(case, way) for way in COLOURS]
        rates = ["" if np.isnan(value) else f"{value:.3g}" for value in values]
        best = int(np.nanargmax(values))
        rates[best] = f"**{rates[best]}**"
        rows = [case["samplers"].get(way) for way in OURS]
        z = [max(row["z"].values()) if row else float("nan") for row in rows]
        lines.append(
            f"| {case['name']} | {case['unknowns']} | {1e3 * case['gradient_s']:.3f} ms | "
            f"{' | '.join(rates)} | {' | '.join(f'{value:.1f}' for value in z)} |"
        )
    return "\n".join(lines)


def draw(cases: list[Case], path: Path) -> None:
    """Draw the rate of each sampler on each posterior."""
    figure, axes = pyplot().subplots(figsize=(8.0, 4.6), layout="constrained")
    for way, colour in COLOURS.items():
        rates = [rate(case, way) for case in cases]
        axes.plot(rates, range(len(cases)), "o", color=colour, ms=7, label=way)
    axes.set(xscale="log", xlabel="effective draws of the slowest unknown by processor second")
    axes.set_yticks(range(len(cases)), [case["name"] for case in cases])
    axes.invert_yaxis()
    axes.grid(axis="x", color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False
    )
    save(figure, path)


def check(cases: list[Case]) -> None:
    """Assert the README's claims."""
    rows = [case["samplers"][way] for case in cases for way in OURS if way in case["samplers"]]
    z = [value for row in rows for value in row["z"].values()]
    assert max(z) < 4.0, max(z)
    assert np.mean(np.array(z) > 3.0) < 0.05
    for case in cases:
        if case["name"] in OBSERVED:
            others = [rate(case, way) for way in COLOURS if way not in OURS]
            assert rate(case, "importance") > np.nanmax(others), case["name"]


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--only", nargs="+", choices=tuple(PROBLEMS), help="posteriors to sample")
    words.add_argument("--draws", type=int, default=500, help="draws of each of four chains")
    words.add_argument("--points", type=int, default=100_000, help="points of the reference")
    words.add_argument("--without", nargs="+", default=[], choices=tuple(COLOURS))
    words.add_argument("--part", help="print one posterior's case as JSON; for the study itself")
    arguments = words.parse_args()
    size = {"draws": arguments.draws, "points": arguments.points}
    if arguments.quick:
        size = {"draws": 200, "points": 20_000}
    if arguments.part:
        print(json.dumps(examine(arguments.part, **size, without=arguments.without)))
        return
    results = Results(arguments.out, SEED, again=arguments.again, settings=size)
    told = [word for key, value in size.items() for word in (f"--{key}", value)]
    told += ["--without", *arguments.without] if arguments.without else []
    for name in arguments.only or (["beam"] if arguments.quick else [*OBSERVED, *BODIES]):
        results.case(name, lambda name=name: printed("samplers", *told, "--part", name))
    results.write()
    print(table(results.cases))
    draw(results.cases, arguments.out / "samplers.png")
    if not arguments.quick:
        check(results.cases)


if __name__ == "__main__":
    main()
