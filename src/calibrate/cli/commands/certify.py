"""``calibrate certify``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from calibrate.cli.common import (
    DONE,
    FAILED,
    add_scheduler,
    emit,
    scheduler_word,
    show_progress,
)
from calibrate.cli.posterior_table import summary
from emulator.core.errors import InputError


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("certify", help="check a posterior against FEM")
    parser.add_argument("folder", metavar="DIR", help="written by calibrate infer")
    parser.add_argument("--draws", type=int, help="FEM runs (default 200)")
    parser.add_argument(
        "--until",
        choices=["decided"],
        help="while the verdict is undecided, double the FEM runs, up to --at-most",
    )
    parser.add_argument(
        "--at-most", type=int, metavar="N", help="FEM runs altogether (default 1000)"
    )
    finer = parser.add_mutually_exclusive_group()
    finer.add_argument(
        "--mesh-runs",
        type=int,
        metavar="N",
        help="solves on the next finer mesh (default: four more than unknowns, at most 15)",
    )
    finer.add_argument("--no-mesh", action="store_true", help="leave the error of the mesh out")
    parser.add_argument(
        "--load-steps", type=int, metavar="N", help="as for simulate (default: the run's own)"
    )
    parser.add_argument(
        "--reweight", metavar="DIR2", help="write FEM's posterior, reweighted from the check, there"
    )
    add_scheduler(parser, "the FEM runs")


def run(arguments: argparse.Namespace) -> int:
    """Check a kept posterior against FEM; a kept reweighted posterior is a success too."""
    from calibrate.project import certify_and_keep, read_posterior, report
    from emulator.core.store import check_folder

    if arguments.reweight is not None:
        target = check_folder(arguments.reweight)
        if target.resolve() == Path(arguments.folder).resolve():
            raise InputError(f"--reweight {target}: that is DIR itself; name another folder")
    if arguments.at_most is not None and arguments.until is None:
        raise InputError("--at-most is of --until decided; give both, or --draws")
    at_most = None
    if arguments.until is not None:
        at_most = 1000 if arguments.at_most is None else arguments.at_most
    scheduler, progress = scheduler_word(arguments), show_progress(arguments)
    plan, posterior = read_posterior(arguments.folder)
    certificate = certify_and_keep(
        posterior,
        arguments.folder,
        draws=arguments.draws,
        at_most=at_most,
        mesh=0 if arguments.no_mesh else arguments.mesh_runs,
        load_steps=plan.load_steps if arguments.load_steps is None else arguments.load_steps,
        reweight_to=arguments.reweight,
        scheduler=scheduler,
        progress=progress,
    )
    result = report(plan, posterior, certificate)
    emit(result, as_json=arguments.json, text=summary(result))
    kept = arguments.reweight is not None and certificate.verdict == "reweight"
    return DONE if kept or certificate.verdict == "accepted" else FAILED
