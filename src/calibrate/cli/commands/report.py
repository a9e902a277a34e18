"""``calibrate report``: one page of a posterior, or of a population."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import DONE, emit, needing_plotly
from emulator.core.errors import InputError


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "report",
        help="one HTML page of a posterior, or of a population, that opens anywhere",
        description="Verdict, data against prediction, parameters, the body in three dimensions "
        "with a slider over draws, what the data determine, and how to repeat it, in one file "
        "that needs no network. Of a population: its medians and spreads, the members beside it, "
        "one not seen, how sampling went, and links to pages of members.",
        epilog="example: calibrate report DIR",
    )
    parser.add_argument("folder", metavar="DIR", help="of calibrate infer")
    parser.add_argument(
        "--out", metavar="FILE.html", help="where to write it (default DIR/report.html)"
    )
    parser.add_argument(
        "--no-fem", action="store_true", help="without the FEM solve that shows the map's error"
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the page."""
    if arguments.out and not arguments.out.endswith(".html"):
        raise InputError(f"--out {arguments.out}: the file name must end in .html")
    with needing_plotly("a report needs"):
        from calibrate.report import write_report
    path = write_report(arguments.folder, arguments.out, fem=not arguments.no_fem)
    emit({"out": str(path)}, as_json=arguments.json, text=f"written to {path}")
    return DONE
