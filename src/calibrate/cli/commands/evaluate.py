"""``calibrate evaluate``: the errors of an emulator at many theta."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calibrate.cli import words
from calibrate.cli.output import table
from calibrate.cli.words import Answer, command, option
from emulator.core.store import check_folder, write_json

_EMULATOR = option("emulator", "EMULATOR", "shipped name or folder")


@command(
    _EMULATOR,
    option("--against", "DIR|fem", "a published model's folder, or our FEM", required=True),
    option("--cases", type=int, help="FEM runs when against fem (default 50)"),
    words.add_forward,
    option("--out", "DIR", "write evaluation.json and figures"),
    help="errors of an emulator against FEM",
)
def evaluate(arguments: Namespace) -> Answer:
    """Compare a forward map with stored or fresh FEM solutions."""
    from calibrate.analysis.evaluation import run_evaluation

    options = words.forward_options(arguments)
    if arguments.out:
        from calibrate.figures import pyplot

        check_folder(arguments.out)
        pyplot()  # a missing plotting package is reported before minutes of FEM
    evaluated = run_evaluation(
        **words.parameters(run_evaluation, arguments),
        forward_options=options,
        progress=not arguments.json,
    )
    report = dict(evaluated.report)
    text = evaluation_summary(report)
    if arguments.out:
        from calibrate.figures.evaluation import draw

        path = Path(arguments.out) / "evaluation.json"
        write_json(path, evaluated.report)
        report["files"] = [str(file) for file in (path, *draw(evaluated, arguments.out))]
        text += f"\nwritten: {', '.join(report['files'])}"
    return Answer(report, text)


def evaluation_summary(report: Mapping[str, Any]) -> str:
    """Return the table of errors as text."""
    rows = [
        (name, *(report[name][q] for q in ("median", "mean", "q97_5", "max")), unit)
        for name, unit in report["units"].items()
        if name in report
    ]
    title = f"{report['cases']} cases"
    lines = [table((title, "median", "mean", "97.5 %", "max", "unit"), rows)]
    lines.append(f"forward map: {report['label']}, reference: {report['reference']}")
    if report["invalid"]:
        lines.append(f"{report['invalid']} further cases without a valid prediction")
    return "\n".join(lines)
