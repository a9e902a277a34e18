"""``calibrate evaluate``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import DONE, emit, show_progress, table
from calibrate.cli.forward import add_forward, forward_options

if TYPE_CHECKING:
    from calibrate.analysis.evaluation import Evaluated


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("evaluate", help="errors of an emulator against FEM")
    parser.add_argument("emulator", metavar="EMULATOR", help="shipped name or folder")
    parser.add_argument(
        "--against", required=True, metavar="DIR|fem", help="a published model's folder, or our FEM"
    )
    parser.add_argument("--cases", type=int, help="FEM runs when against fem (default 50)")
    parser.add_argument(
        "--outside",
        type=float,
        metavar="FRACTION",
        help="evaluate at as many theta again outside the box, each side widened by this fraction",
    )
    add_forward(parser)
    parser.add_argument("--out", metavar="DIR", help="write evaluation.json and figures")


def run(arguments: argparse.Namespace) -> int:
    """Compare a forward map with stored or fresh FEM solutions."""
    from calibrate.analysis.evaluation import Evaluation, run_evaluation

    names = ("emulator", "against", "cases", "outside", "forward")
    plan = Evaluation(
        **{name: getattr(arguments, name) for name in names},
        forward_options=forward_options(arguments),
    )
    if arguments.out:
        from calibrate.figures.drawing import pyplot
        from emulator.core.store import check_folder

        check_folder(arguments.out)
        pyplot()  # a missing plotting package is reported before minutes of FEM
    evaluated = run_evaluation(plan, progress=show_progress(arguments))
    files = [str(path) for path in save(evaluated, arguments.out)] if arguments.out else []
    report = {**evaluated.report, **({"files": files} if files else {})}
    text = summary(report) + (f"\nwritten: {', '.join(files)}" if files else "")
    emit(report, as_json=arguments.json, text=text)
    return DONE


def save(evaluated: Evaluated, folder: str | Path) -> list[Path]:
    """Write evaluation.json and the figures to ``folder``; the files written."""
    from calibrate.figures.evaluation import draw
    from emulator.core.store import write_json

    path = Path(folder) / "evaluation.json"
    write_json(path, evaluated.report)
    return [path, *draw(evaluated, folder)]


def summary(report: Mapping[str, Any]) -> str:
    """The tables of errors as text."""
    lines = [_table(report, f"{report['cases']} cases")]
    lines.append(f"forward map: {report['label']}, reference: {report['reference']}")
    if report["invalid"]:
        lines.append(f"{report['invalid']} further cases without a valid prediction")
    if outside := report.get("outside"):
        title = f"{outside['cases']} cases outside"
        lines += ["", _table({**outside, "units": report["units"]}, title)]
        lines.append(
            f"box widened by {outside['fraction']:g} of each side; further cases: FEM failed at "
            f"{outside['failed']}, the map had no valid prediction at {outside['invalid']}"
        )
    return "\n".join(lines)


def _table(report: Mapping[str, Any], title: str) -> str:
    rows = [
        (name, *(report[name][q] for q in ("median", "mean", "q97_5", "max")), unit)
        for name, unit in report["units"].items()
        if name in report
    ]
    return table((title, "median", "mean", "97.5 %", "max", "unit"), rows)
