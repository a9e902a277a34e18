"""How many FEM runs, and how much time, does a given error cost? Ours beside POD + GP.

    python -m studies.few_runs --workers 2     # both ventricles, then other meshes
    python -m studies.few_runs --parts left_ventricle --mesh 4 8 1 --runs 1 5 --out DIR

Each part runs in a process of its own, so that each pays for its own compilation. Writes
results.json, runs.png, time.png and asserts what the README of the study says.
"""

import argparse
import json
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from studies.common.output import study_header
from studies.common.processes import command, environment
from studies.few_runs.accuracy import SEED, accuracy
from studies.few_runs.figures import draw_meshes, draw_runs, draw_time
from studies.few_runs.meshes import mesh_case
from studies.few_runs.tables import check, summary, tables

from emulator.core.store import write_json

HERE = Path(__file__).parent
RUNS = [1, 5, 10, 20, 30, 60, 120]
LONGER = {"left_ventricle": [300, 600, 1200]}  # FEM runs that three and ten minutes allow
TESTS = 60
ORDER = 3
MESHES = {"mesh_10_20_2": (10, 20, 2), "mesh_22_44_4": (22, 44, 4), "mesh_28_56_6": (28, 56, 6)}
PARTS = ["left_ventricle", "left_ventricle_segments", *MESHES]
MESH_RUNS = 10
MESH_TESTS = 8


def part(name: str, arguments: argparse.Namespace) -> list[dict]:
    """The rows of one part."""
    if name in MESHES:
        return [mesh_case(MESHES[name], MESH_RUNS, MESH_TESTS, arguments.order)]
    shape = None if arguments.mesh is None else tuple(arguments.mesh)
    more = LONGER.get(name, []) if arguments.runs == RUNS else []
    return accuracy(
        name, sorted(arguments.runs) + more, arguments.tests, arguments.order, shape,
        lambda cases: write_json(arguments.out / "part.json", cases),
    )  # fmt: skip


def in_own_process(name: str, words: list[str]) -> list[dict]:
    """:func:`part` in a fresh interpreter."""
    with tempfile.TemporaryDirectory() as folder:
        part = command("few_runs", *words, "--only", name, "--out", folder)
        subprocess.run(part, check=True, env=environment())
        return json.loads((Path(folder) / "part.json").read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS, metavar="PART")
    parser.add_argument("--runs", nargs="+", type=int, default=RUNS, help="numbers of FEM runs")
    parser.add_argument("--tests", type=int, default=TESTS, help="test theta")
    parser.add_argument("--order", type=int, default=ORDER, help="of the Taylor series")
    parser.add_argument("--mesh", nargs=3, type=int, help="rings, around, layers of a smaller one")
    parser.add_argument("--workers", type=int, default=1, help="parts at a time")
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.only:
        write_json(arguments.out / "part.json", part(arguments.only, arguments))
        return
    words = ["--tests", str(arguments.tests), "--order", str(arguments.order)]
    words += ["--runs", *map(str, arguments.runs)]
    words += [] if arguments.mesh is None else ["--mesh", *map(str, arguments.mesh)]
    with ThreadPoolExecutor(arguments.workers) as pool:
        parts = pool.map(lambda name: in_own_process(name, words), arguments.parts)
        cases = [case for rows in parts for case in rows]
    report(cases, arguments.out, full=arguments.mesh is None and arguments.parts == PARTS)


def report(cases: list[dict], out: Path, *, full: bool) -> None:
    """Results, figures and the claims of the README."""
    found = {**study_header(HERE, SEED), "summary": summary(cases), "cases": cases}
    write_json(out / "results.json", found)
    draw_runs(cases, out / "runs.png")
    draw_time(cases, out / "time.png")
    if any(case["kind"] == "mesh" for case in cases):
        draw_meshes(cases, out / "meshes.png")
    print(tables(cases))
    if full:
        check(cases)


if __name__ == "__main__":
    main()
