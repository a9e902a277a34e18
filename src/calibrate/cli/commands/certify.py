"""``calibrate certify``."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import DONE, FAILED, add_json, emit, show_progress
from calibrate.cli.posterior_table import summary


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("certify", help="check a posterior against FEM")
    parser.add_argument("folder", metavar="DIR", help="written by calibrate infer")
    parser.add_argument("--draws", type=int, help="FEM runs (default 200, or all draws)")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Check a kept posterior against FEM."""
    from calibrate.workflow import certify_and_keep, read_posterior, report

    progress = show_progress(arguments)
    plan, posterior = read_posterior(arguments.folder)
    certificate = certify_and_keep(
        posterior, arguments.folder, draws=arguments.draws, progress=progress
    )
    result = report(plan, posterior, certificate)
    emit(result, as_json=arguments.json, text=summary(result))
    return DONE if certificate.verdict == "accepted" else FAILED
