"""A benchmark of inference on a passive left ventricle: data, reference draws, scores.

    python -m studies.inverse_benchmark                  # all that is missing, then the leaderboard
    python -m studies.inverse_benchmark --score FOLDER   # scores of an entry of yours
    python -m studies.inverse_benchmark --quick --out DIR

Thirteen data sets: volume, displacements, strains or all of them, at three levels of noise, and one
made on a finer mesh. README.md says how to enter. Writes results.json and inverse_benchmark.png.
"""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.output import Case, Results, parser, write_json
from studies.inverse_benchmark import entries, reference, tables
from studies.inverse_benchmark.entries import ENTRIES, OURS, Entry
from studies.inverse_benchmark.figure import draw
from studies.inverse_benchmark.problems import PROBLEMS, SEED, Problem, data_of, scene_of
from studies.inverse_benchmark.score import score

import emulator as em

HERE = Path(__file__).parent
NEEDS = {"emcee": "emcee", "pymc": "pymc"}  # packages of entries that are not ours
QUICK = ("volume_mid",)


def references(results: Results, problems: list[Problem]) -> None:
    """Data sets and their reference draws, where they are missing."""
    for problem in problems:
        data_of(problem)

        def make(problem: Problem = problem) -> Case:
            return reference.make(problem, entries.EMULATOR()[0], entries.simulator())

        results.case(f"reference: {problem.name}", make)


def enter(key: str, entry: Entry) -> None:
    """All draws of an entry of ``OURS`` that are missing, and what they took."""
    folder = ENTRIES / key
    path = folder / "entry.json"
    told: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {"problems": {}}
    missing = [name for name in PROBLEMS if name not in told["problems"]]
    if missing and key in NEEDS and importlib.util.find_spec(NEEDS[key]) is None:
        print(f"{entry.name}: {len(missing)} problems left out, package '{NEEDS[key]}' is missing")
        return
    for name in missing:
        _, offline, runs = entry.forward()
        told |= {"name": entry.name, "offline_s": offline, "offline_fem_runs": runs}
        columns, took = entries.draw(entry, PROBLEMS[name])
        tables.write(folder / f"{name}.csv", scene_of().parameter_names, columns)
        told["problems"][name] = took
        write_json(path, told)
        print(f"{entry.name}, {name}: {took}", flush=True)


def scored(folder: Path) -> Case:
    """Scores of all the problems that ``folder`` has draws of, and what they say together.

    Raises
    ------
    InputError
        No file of any problem, or one that cannot be read.
    """
    found = {}
    for name, problem in PROBLEMS.items():
        path = folder / f"{name}.csv"
        if path.is_file():
            names = scene_of().parameter_names
            table = tables.read(path, names)
            found[name] = score(table, tables.read(reference.path_of(problem), names))
    if not found:
        raise em.InputError(
            f"{folder}: no draws; name files by problem, e.g. {next(iter(PROBLEMS))}.csv"
        )
    path = folder / "entry.json"
    told = json.loads(path.read_text()) if path.is_file() else {}
    took = told.get("problems", {})
    return {
        "entry": told.get("name", folder.name),
        "problems": len(found),
        "sliced": float(np.median([one["sliced"] for one in found.values()])),
        "sliced_worst": max(one["sliced"] for one in found.values()),
        "floor": float(np.median([one["floor"] for one in found.values()])),
        "largest_shift": max(one["largest_shift"] for one in found.values()),
        "largest_log_sd": max(one["largest_log_sd"] for one in found.values()),
        "processor_s": _median(took, "processor_s"),
        "fem_solves": _median(took, "fem_solves"),
        "offline_s": told.get("offline_s"),
        "offline_fem_runs": told.get("offline_fem_runs"),
        "scores": found,
    }


def _median(took: dict[str, Any], key: str) -> float | None:
    return float(np.median([one[key] for one in took.values()])) if took else None


def leaderboard(cases: list[Case]) -> str:
    """The entries, best first, as a table of the README."""
    rows = [
        "| entry | problems | sliced Wasserstein, median | worst | floor | largest shift | largest "
        "sd ratio | processor time a problem | FEM solves a problem | before |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for c in sorted(cases, key=lambda c: c["sliced"]):
        seconds = "" if c["processor_s"] is None else f"{c['processor_s']:.0f} s"
        before = (
            ""
            if c["offline_s"] is None
            else f"{c['offline_s']:.0f} s, {c['offline_fem_runs']} FEM runs"
        )
        rows.append(
            f"| {c['entry']} | {c['problems']} | {c['sliced']:.3f} sd | {c['sliced_worst']:.3f} | "
            f"{c['floor']:.3f} | {c['largest_shift']:.2f} sd | {np.exp(c['largest_log_sd']):.2f} | "
            f"{seconds} | {c['fem_solves'] or 0:.0f} | {before} |"
        )
    return "\n".join(rows)


def check(cases: list[Case]) -> None:
    """The README's claims."""
    by_entry = {case["entry"]: case for case in cases if "entry" in case}
    best = by_entry[OURS["emulator_nuts"].name]
    assert best["sliced"] < 2.0 * best["floor"]
    assert best["largest_shift"] < 0.25
    for case in cases:
        if "weights_ess" in case:
            assert case["weights_ess"] > reference.SMALLEST_ESS
            assert case["failed"] == 0


def check_quick(folder: Path) -> None:
    """The scorer tells right draws from wrong ones: moved, narrowed, and the reference itself."""
    problem, names = PROBLEMS[QUICK[0]], scene_of().parameter_names
    whole = tables.read(reference.path_of(problem), names)
    same = score(whole, whole)
    assert max(same["sliced"], same["largest_shift"]) < 1e-9
    halves = score(whole.part(slice(0, None, 2)), whole)
    assert halves["sliced"] < 2.0 * halves["floor"]
    narrow = whole._replace(draws=whole.mean() + 0.5 * (whole.draws - whole.mean()))
    assert score(narrow, whole)["sliced"] > 4.0 * halves["floor"]
    tables.write(folder / "mine" / f"{problem.name}.csv", names, whole.draws[:100])
    assert scored(folder / "mine")["problems"] == 1


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--score", type=Path, help="folder of draws to score")
    arguments = words.parse_args()
    if arguments.score is not None:
        try:
            found = scored(arguments.score)
        except em.InputError as error:
            raise SystemExit(str(error)) from None
        for name, one in found["scores"].items():
            print(
                f"{name}: sliced {one['sliced']:.3f} sd (floor {one['floor']:.3f}), shift "
                f"{one['largest_shift']:.2f} sd, sd ratio {np.exp(one['largest_log_sd']):.2f}"
            )
        print(leaderboard([found]))
        return
    settings = {"quick": arguments.quick}
    results = Results(arguments.out, SEED, again=arguments.again, settings=settings)
    if not arguments.quick:
        references(results, list(PROBLEMS.values()))
        for key, entry in OURS.items():
            enter(key, entry)
    results.cases = [case for case in results.cases if "entry" not in case]
    for folder in sorted(path.parent for path in ENTRIES.glob("*/entry.json")):
        results.case(f"entry: {folder.name}", lambda folder=folder: scored(folder))
    entered = [case for case in results.cases if "entry" in case]
    results.write()
    print(leaderboard(entered))
    draw(entered, arguments.out / "inverse_benchmark.png")
    check(results.cases)
    if arguments.quick:
        check_quick(arguments.out)


if __name__ == "__main__":
    main()
