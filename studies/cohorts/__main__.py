"""Real tissues as cohorts: one command from a table of subjects to a population.

    python -m studies.cohorts --data DIR [--engine WORDS]    # DIR as ../shared/measured
    python -m studies.cohorts --data DIR --quick
    python -m studies.cohorts --data DIR --keep FOLDER       # goes on where it was stopped

Each subject is a table of its tests, calibrated and certified by itself; those that do not fail
make a population. Writes results.json after each cohort, and cohorts.png.
"""

import csv
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
from studies.common.figures import BLUE, GREEN, ORANGE, pyplot
from studies.common.output import Case, Results, parser, run, save
from studies.common.pieces import A_FEW_CLOTS, CLOTS, HEARTS, Piece, clots, sheep
from studies.common.processes import calibrate

HERE = Path(__file__).parent
SEED = 0
GROUP_LETTERS = 3  # of a name that say its group: the clots' calcium
QUANTILE = 1.645  # sds
OF_ALL = ("median[", "sd[", "correlation[")  # beginnings of names of what all subjects share
COLOURS = (BLUE, ORANGE, GREEN)


def cohort(pieces: Iterator[Piece], law: str, engine: str, folder: Path) -> Case:
    """The posterior and verdict of each subject, and of the population."""
    rows = [["subject", "data", "group"]]
    for piece in pieces:
        piece.write(folder / f"{piece.name}.csv", np.ones(len(piece.rows), bool))
        rows.append([piece.name, f"{piece.name}.csv", piece.name[:GROUP_LETTERS]])
    with (folder / "subjects.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    begin, whole = perf_counter(), not (folder / "cohort").exists()
    words = ("--law", law, "--engine", engine, "--seed", SEED, "--out", "cohort")
    told = calibrate(folder, "cohort", "subjects.csv", *words)
    seconds = perf_counter() - begin
    groups = {name: group for name, _, group in rows[1:]}
    return {
        "law": law,
        "engine": engine,
        "subjects": len(groups),
        "groups": groups,
        "accepted": sum(of["verdict"] == "accepted" for of in told["members"].values()),
        "failed": told["failed"],
        "population": {n: row for n, row in told["population"].items() if n.startswith(OF_ALL)},
        "members": told["members"],
        "seconds" if whole else "seconds_of_the_rest": round(seconds, 1),
    }


def draw(cases: list[Case], path: Path) -> None:
    """Each subject's first parameter, mean and 90 %: alone (grey), and in its population."""
    figure, axes = pyplot().subplots(
        1, len(cases), figsize=(4.5 * len(cases), 4.0), layout="constrained", squeeze=False
    )
    for axis, case in zip(axes[0], cases, strict=True):
        names, groups = list(case["members"]), sorted(set(case["groups"].values()))
        parameter = next(iter(case["population"])).removeprefix("median[").removesuffix("]")
        for k, name in enumerate(names):
            row: dict[str, float] = case["members"][name][parameter]
            colour = COLOURS[groups.index(case["groups"][name]) % len(COLOURS)]
            for kind, shade, y in (("alone_", "0.7", k + 0.2), ("", colour, k - 0.1)):
                mean, half = row[f"{kind}mean"], QUANTILE * row[f"{kind}sd"]
                axis.plot([mean - half, mean + half], [y, y], color=shade)
                axis.plot(mean, y, "o", color=shade, ms=4)
        axis.set(xlabel=f"{parameter} (kPa), 90 %", title=case["name"])
        axis.set_yticks(range(len(names)), names, fontsize=7)
        axis.invert_yaxis()
    save(figure, path)


def main() -> None:
    """Run the study."""
    words = parser(__doc__, HERE)
    words.add_argument("--data", type=Path, required=True, help="folder of the measurements")
    words.add_argument("--engine", default="processes:2")
    words.add_argument("--keep", type=Path, help="folder of the cohorts, which go on there")
    arguments = words.parse_args()
    results = Results(arguments.out, SEED, again=arguments.again)
    data, quick = arguments.data, arguments.quick
    every: dict[str, tuple[Callable[[], Iterator[Piece]], str]] = {
        "clots": (lambda: clots(data, A_FEW_CLOTS if quick else CLOTS), "ogden_1"),
        "sheep hearts": (lambda: sheep(data, HEARTS), "holzapfel_ogden_orthotropic"),
    }
    with tempfile.TemporaryDirectory() as place:
        for name, (pieces, law) in list(every.items())[: 1 if quick else None]:
            folder = (arguments.keep or Path(place)).resolve() / name.replace(" ", "_")
            folder.mkdir(parents=True, exist_ok=True)
            results.case(
                name, lambda p=pieces, law=law, at=folder: cohort(p(), law, arguments.engine, at)
            )
    results.write()
    draw(results.cases, arguments.out / "cohorts.png")


if __name__ == "__main__":
    run(main)
