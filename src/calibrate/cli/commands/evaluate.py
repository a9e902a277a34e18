"""``calibrate evaluate``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from calibrate.cli.common import DONE, add_json, emit, show_progress, table
from emulator.errors import InputError

_FORWARDS = ("emulator", "corrected", "reduced")


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("evaluate", help="errors of an emulator against FEM")
    parser.add_argument("emulator", metavar="EMULATOR", help="shipped name or folder")
    parser.add_argument(
        "--against", required=True, metavar="DIR|fem", help="a published model's folder, or our FEM"
    )
    parser.add_argument("--cases", type=int, default=50, help="FEM runs when against fem")
    parser.add_argument(
        "--outside",
        type=float,
        metavar="FRACTION",
        help="as many FEM runs again outside the box, each side widened by this much of it",
    )
    parser.add_argument(
        "--forward", choices=_FORWARDS, default="emulator", help="made of the emulator or its scene"
    )
    parser.add_argument("--steps", type=int, help="Newton steps of the corrected map (default 1)")
    parser.add_argument(
        "--fem-runs", type=int, help="that the reduced model is fitted to (default 30)"
    )
    parser.add_argument("--out", metavar="DIR", help="write evaluation.json and figures")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare a forward map with stored or fresh FEM solutions."""
    given = {name: getattr(arguments, name) for name in ("steps", "fem_runs")}
    given = {name: value for name, value in given.items() if value is not None}
    for name, kind in (("steps", "corrected"), ("fem_runs", "reduced")):
        if name in given and arguments.forward != kind:
            option = name.replace("_", "-")
            raise InputError(f"--{option} has no effect without --forward {kind}")
    from calibrate.evaluation import Evaluation, run_evaluation, save

    names = ("emulator", "against", "cases", "outside", "forward")
    plan = Evaluation(**{name: getattr(arguments, name) for name in names}, **given)
    if arguments.out:
        from calibrate.figures.drawing import pyplot
        from emulator.store import check_folder

        check_folder(arguments.out)
        pyplot()  # before minutes are spent on what it is to draw
    evaluated = run_evaluation(plan, progress=show_progress(arguments))
    files = [str(path) for path in save(evaluated, arguments.out)] if arguments.out else []
    report = {**evaluated.report, **({"files": files} if files else {})}
    text = summary(report) + (f"\nwritten: {', '.join(files)}" if files else "")
    emit(report, as_json=arguments.json, text=text)
    return DONE


def summary(report: Mapping[str, Any]) -> str:
    """The tables for people."""
    lines = [_table(report, f"{report['cases']} cases")]
    lines.append(f"forward map: {report['forward']}, reference: {report['reference']}")
    if report["invalid"]:
        lines.append(f"{report['invalid']} cases more without a valid answer")
    if outside := report.get("outside"):
        title = f"{outside['cases']} cases outside"
        lines += ["", _table({**outside, "units": report["units"]}, title)]
        lines.append(
            f"box widened by {outside['fraction']:g} of each side; {outside['failed']} more where "
            f"FEM failed, {outside['invalid']} where the map did"
        )
    return "\n".join(lines)


def _table(report: Mapping[str, Any], title: str) -> str:
    rows = [
        (name, *(report[name][q] for q in ("median", "mean", "q97_5", "max")), unit)
        for name, unit in report["units"].items()
        if name in report
    ]
    return table((title, "median", "mean", "97.5 %", "max", "unit"), rows)
