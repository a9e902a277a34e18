"""Hard cases: each must end well or name its failure, never answer wrongly.

Run from anywhere: ``python -m studies.stability``. Writes results.json, after each case, and
stability.png beside itself and asserts what the README of the study says. Cases that results.json
holds are kept.
"""

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from studies.common.figures import pyplot
from studies.common.output import save, study_header, write_json
from studies.stability import emulation
from studies.stability.cases import CASES
from studies.stability.judge import TOLERANCE
from studies.stability.solver.case import SEED
from studies.stability.workers import study

import emulator as em

HERE = Path(__file__).parent
LIMIT = 120.0  # seconds for one case, compilation and judgement included

COLOURS = {
    "CONVERGED": "tab:green",
    "ITERATION_LIMIT": "tab:orange",
    "LOAD_LIMIT": "tab:blue",
    "INVERTED_ELEMENT": "tab:purple",
    "SINGULAR_TANGENT": "tab:brown",
    "INVALID_INPUT": "0.5",
    "InputError": "0.2",
    "SolverError": "0.35",
    "TRAINED": "tab:green",
    "PREDICTED": "tab:green",
    "AGREES": "tab:green",
    "OUTSIDE": "tab:cyan",
    "WARNED": "tab:olive",
}


WRONG = "silent wrong"


def ended(row: dict[str, Any]) -> str:
    """How a case ended, as figure and table have it."""
    return WRONG if row["silent_wrong"] else str(row["status"])


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """How the cases of each family ended, and the residual of those that converged."""
    plt = pyplot()
    families = list(dict.fromkeys(row["family"] for row in rows))[::-1]
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(12, 0.5 * len(families) + 2.2), sharey=True, layout="constrained"
    )
    lengths = np.zeros(len(families))
    for status in [*COLOURS, *sorted({ended(row) for row in rows} - set(COLOURS))]:
        counts = np.array(
            [sum((r["family"], ended(r)) == (f, status) for r in rows) for f in families]
        )
        if counts.any():
            colour = COLOURS.get(status, "tab:red" if status == WRONG else "tab:pink")
            left.barh(families, counts, left=lengths, color=colour, label=status)
            lengths += counts
    left.set(xlabel="cases")
    figure.legend(frameon=False, fontsize=9, loc="outside upper center", ncols=7)
    for height, family in enumerate(families):
        found = [r for r in rows if r["family"] == family and r["residual"] is not None]
        spread = np.linspace(-0.3, 0.3, max(len(found), 2))
        for row, shift in zip(found, spread, strict=False):
            colour = "tab:red" if row["silent_wrong"] else "tab:green"
            mark = "x" if row["stable"] is False else "o"
            # A residual of exactly zero is drawn at round-off.
            right.plot(max(row["residual"], 1e-17), height + shift, mark, color=colour, ms=4)
    right.axvline(TOLERANCE, color="tab:red", lw=1)
    right.set(xscale="log", xlabel="residual, judged independently (x: a saddle, not a minimum)")
    right.grid(alpha=0.25)
    save(figure, path)


NAMED = {status.name for status in em.fem.Status} | set(COLOURS)


def check(rows: list[dict[str, Any]]) -> None:
    """The claims of the study's README."""
    by_name = {row["name"]: row for row in rows}
    wrong = {row["name"] for row in rows if row["silent_wrong"]}
    assert not wrong, f"silent wrong answers: {sorted(wrong)}"
    unnamed = {row["name"]: row["status"] for row in rows if row["status"] not in NAMED}
    assert not unnamed, f"hangs or exceptions: {unnamed}"
    for row in rows:
        if row["family"] == "corners of the boxes":
            assert row["status"] == "CONVERGED", row["name"]
    if (flattened := by_name.get("pushed_through_itself")) is not None:
        assert flattened["status"] == "INVERTED_ELEMENT"


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts of the table in the README."""
    converged = [row for row in rows if row["status"] == "CONVERGED"]
    return {
        "cases": len(rows),
        "statuses": dict(Counter(row["status"] for row in rows)),
        "silent_wrong": sum(row["silent_wrong"] for row in rows),
        "saddles": [row["name"] for row in converged if row["stable"] is False],
        "largest_residual": max((row["residual"] or 0.0 for row in converged), default=0.0),
        "longest_s": max(row["time_s"] for row in rows),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """How each family ended, as the README has it."""
    found = {ended(row) for row in rows}
    names = [name for name in COLOURS if name in found] + sorted(found - set(COLOURS))
    words = [name.replace("_", " ").lower() if name.isupper() else name for name in names]
    lines = [f"| family | cases | {' | '.join(words)} |", "|---" * (len(names) + 2) + "|"]
    families = dict.fromkeys(row["family"] for row in rows)
    for family in [*families, "all"]:
        count = Counter(ended(row) for row in rows if family in (row["family"], "all"))
        cells = " | ".join(str(count[name] or "") for name in names)
        lines.append(f"| {family} | {count.total()} | {cells} |")
    return "\n".join(lines)


def _kept(row: dict[str, Any], chosen: tuple[str, ...], again: bool) -> bool:
    """Whether a row of results.json is not to be made again."""
    good = row["status"] in NAMED and not row["silent_wrong"]
    return not row["name"].startswith(chosen) or (good and not again)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", help="names, or beginnings of names; all by default")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds a case")
    parser.add_argument("--again", action="store_true", help="repeat cases that results.json has")
    parser.add_argument("--out", type=Path, default=HERE)
    arguments = parser.parse_args()
    chosen = tuple(arguments.cases or [""])
    path = arguments.out / "results.json"
    there = json.loads(path.read_text())["cases"] if path.is_file() else []
    known = [row for row in there if _kept(row, chosen, arguments.again)]
    had = {row["name"] for row in there}
    names = [name for name in CASES if name in had or name.startswith(chosen)]
    header = study_header(HERE, SEED)

    def keep(rows: list[dict[str, Any]]) -> None:
        write_json(path, {**header, "summary": summary(rows), "cases": rows})

    rows = study(names, arguments.workers, arguments.limit, known, keep)
    found = summary(rows)
    keep(rows)
    draw(rows, arguments.out / "stability.png")
    above = [row for row in rows if row["name"] in emulation.CASES]
    below = [row for row in rows if row["name"] not in emulation.CASES]
    print(*(table(part) for part in (below, above) if part), found, sep="\n\n")
    check(rows)


if __name__ == "__main__":
    main()
