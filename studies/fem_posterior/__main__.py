"""The emulator's posterior against FEM's, and what each way to FEM's posterior costs.

    python -m studies.fem_posterior                       # some 45 minutes of processor time
    python -m studies.fem_posterior --quick --out DIR     # the beam, short runs
    python -m studies.fem_posterior --parts beam          # one part; the others' rows stay

Three ways to one posterior: NUTS with FEM as its forward map, the same tuned by the emulator's
posterior, and the emulator with a certificate. Each problem runs in a process
of its own, with nothing compiled before. Writes results.json and costs.png and asserts what the
README of the study says.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.output import commit, study_header
from studies.common.processes import command, environment
from studies.fem_posterior.comparison import largest, of_weights, with_agreement
from studies.fem_posterior.figure import draw
from studies.fem_posterior.methods import (
    CHEAP,
    PLAIN,
    Outcome,
    Sizes,
    by_emulator,
    by_fem,
    by_tuned_fem,
    weigh,
)
from studies.fem_posterior.problems import PROBLEMS, Problem
from studies.fem_posterior.shifts import PAIRED, SHIFT, certificates
from studies.fem_posterior.tables import tables

from emulator.core.store import write_json

HERE = Path(__file__).parent
SEED = 0
SIZES = {name: Sizes() for name in PROBLEMS}
SIZES["cube"] = Sizes(warmup=100, draws=150, tuned=(50, 150))
SIZES["coarse"] = Sizes(warmup=300, draws=500)
SIZES["ventricle"] = Sizes(weighed=300)
# NUTS with FEM as its forward map; on 1564 nodes it would take hours.
FEM_RUNS = dict.fromkeys(PROBLEMS, ("tuned", "plain")) | {"ventricle": ()}
QUICK = Sizes(2, 10, 10, (10, 10), 30, 30, (100, 100))
SHIFTS = "shifts"  # the part on certificates
PARTS = (*PROBLEMS, SHIFTS)
LARGEST_SHIFT, LARGEST_LOG_SD, TIMES_FASTER = 0.1, float(np.log(1.1)), 10.0


def examine(problem: Problem, sizes: Sizes, fem_runs: tuple[str, ...]) -> dict[str, Any]:
    """All ways to one posterior, compared; ``fem_runs`` are those of NUTS with FEM."""
    names = problem.cheap.names
    cheap, posterior = by_emulator(problem, sizes, SEED)
    _say(cheap)
    weighed = of_weights(weigh(problem, posterior, sizes.weighed), names)
    print(f"  weights: {weighed['shift']} {weighed['log_sd']}", flush=True)
    runs = [cheap]
    if "tuned" in fem_runs:
        runs.append(by_tuned_fem(problem, posterior, sizes, SEED, cheap.more["sampling_s"]))
        _say(runs[-1])
    if "plain" in fem_runs:
        runs.append(by_fem(problem, sizes, SEED))
        _say(runs[-1])
    return {
        "name": problem.name,
        "status": cheap.more["verdict"],
        "commit": commit(HERE),
        "nodes": problem.nodes,
        "names": list(names),
        "weights": weighed,
        "largest_shift": largest(weighed, "shift"),
        "largest_log_sd": largest(weighed, "log_sd"),
        "runs": [run.to_json() for run in runs],
    }


def _say(run: Outcome) -> None:
    found = run.to_json()
    print(
        f"  {run.method:32s} ESS {found['effective']:6.0f}  R-hat {found['r_hat']:.3f}  solves "
        f"{run.solves:6d}  a draw {found['solves_per_effective_draw']:8.2f}  {run.seconds:6.0f} s "
        f"again {run.again_s} {run.more}",
        flush=True,
    )


def in_own_process(name: str, *, quick: bool) -> dict[str, Any]:
    """:func:`examine` in a fresh interpreter, without a cache of compiled programs."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["--quick"] if quick else []
        part = command("fem_posterior", "--only", name, "--out", folder, *words)
        subprocess.run(part, check=True, env=environment(compiled=False))
        return json.loads((Path(folder) / "part.json").read_text())


def part(name: str, *, quick: bool) -> dict[str, Any]:
    """One problem's case, or the one on certificates."""
    if name == SHIFTS:
        return {**certificates(PROBLEMS["coarse"]()), "commit": commit(HERE)}
    if quick:
        return examine(PROBLEMS[name](), QUICK, ("tuned",))
    return examine(PROBLEMS[name](), SIZES[name], FEM_RUNS[name])


def check(cases: dict[str, dict[str, Any]]) -> None:
    """The README's claims."""
    for key, case in cases.items():
        if key == SHIFTS:
            assert all(found["rms_z"] < 1.5 for found in case["summary"].values())
            assert case["summary"][PAIRED]["rms"] < 0.5 * case["summary"][SHIFT]["rms"]
            continue
        for (value, error), limit in (
            (case["largest_shift"], LARGEST_SHIFT),
            (case["largest_log_sd"], LARGEST_LOG_SD),
        ):
            assert value + 2.0 * error < limit, case["name"]
        for found in case["agreement"]:
            assert found["rms_z"] < 2.0, (case["name"], found["of"], found["against"])
            assert found["largest_z"] < 4.0, (case["name"], found["of"], found["against"])
        rates = {run["method"]: run["effective_per_s"] for run in case["runs"]}
        if PLAIN in rates:
            assert rates[CHEAP] > TIMES_FASTER * rates[PLAIN], case["name"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS, metavar="PART")
    parser.add_argument("--quick", action="store_true", help="the beam, short runs")
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.only:
        write_json(arguments.out / "part.json", part(arguments.only, quick=arguments.quick))
        return
    path = arguments.out / "results.json"
    kept = {c["key"]: c for c in json.loads(path.read_text())["cases"]} if path.exists() else {}
    for key in ["beam"] if arguments.quick else arguments.parts:
        print(key, flush=True)
        kept[key] = {**in_own_process(key, quick=arguments.quick), "key": key}
        if key in PROBLEMS:
            kept[key] = with_agreement(kept[key])
        cases = [kept[k] for k in PARTS if k in kept]
        write_json(path, {**study_header(HERE, SEED), "cases": cases})
        draw([case for case in cases if case["key"] in PROBLEMS], arguments.out / "costs.png")
    print(tables(cases))
    if not arguments.quick:
        check(kept)


if __name__ == "__main__":
    main()
