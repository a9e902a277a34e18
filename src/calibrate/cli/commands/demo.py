"""``calibrate demo``."""

from __future__ import annotations

import argparse
import time
from typing import Any

from calibrate.cli.common import DONE, FAILED, emit, show_progress
from calibrate.cli.posterior_table import summary
from calibrate.project.demo import DEMOS, run_demo


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "demo", help="the whole job on a built-in beam in under a minute, or on a ventricle"
    )
    parser.add_argument(
        "--scene",
        choices=tuple(DEMOS),
        default=next(iter(DEMOS)),
        help="the beam (default), or the left ventricle from a volume and 24 landmarks, in minutes",
    )
    parser.add_argument("--out", default="demo-output", metavar="DIR")


def run(arguments: argparse.Namespace) -> int:
    """Run the demo and show the report."""
    started = time.perf_counter()
    report = run_demo(arguments.out, arguments.scene, progress=show_progress(arguments))
    report["seconds"] = round(time.perf_counter() - started, 1)
    report["files"] = [
        f"{arguments.out}/{name}"
        for name in ("posterior.nc", "certificate.json", report.pop("picture"))
    ]
    lines = [summary(report)]
    if "identifiability" in report:
        from calibrate.analysis.identifiability import in_words

        lines.append(in_words(report["identifiability"]))
    lines.append(f"written: {', '.join(report['files'])} ({report['seconds']:.0f} s)")
    text = "\n".join(lines)
    emit(report, as_json=arguments.json, text=text)
    return DONE if report["verdict"] == "accepted" else FAILED
