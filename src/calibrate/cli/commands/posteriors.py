"""``calibrate infer``, ``certify``, ``report``, ``compare`` and ``demo``: posteriors in folders."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.output import (
    DONE,
    FAILED,
    emit,
    members_summary,
    needing_plotly,
    posterior_summary,
    show_progress,
    table,
)
from calibrate.cli.words import add_load_steps, add_scheduler, answer, scheduler_word
from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    from calibrate.posterior.comparison import Comparison
    from calibrate.project.members import Members


def add_infer(commands: Any) -> None:
    """Add the command."""
    from calibrate.cli.run_words import SAMPLING, add_run

    parser = commands.add_parser(
        "infer",
        help="sample a posterior",
        epilog="examples: calibrate infer SCENE --data measured.csv --noise 0.2 --out DIR; "
        "calibrate infer experiment.toml --out DIR",
    )
    add_run(parser, SAMPLING)
    parser.add_argument(
        "--no-certify", action="store_true", help="leave the check against FEM for later"
    )
    parser.add_argument("--out", required=True, metavar="DIR")
    parser.add_argument(
        "--force", action="store_true", help="replace the results of an earlier run in DIR"
    )
    answer(parser, run_infer)


def run_infer(arguments: argparse.Namespace) -> int:
    """Sample and certify a posterior, or those of members of a population, and save them."""
    from calibrate.cli.run_words import SAMPLING, check_warmup, plan_of
    from calibrate.project import certify_and_keep, infer, report
    from calibrate.project.members import Members

    folder, progress = check_folder(arguments.out), show_progress(arguments)
    problem = plan_of(arguments, SAMPLING)
    if isinstance(problem, Members):
        return _infer_members(arguments, problem, folder)
    check_warmup(problem, arguments)
    run = problem.run
    posterior = infer(problem, folder, force=arguments.force, progress=progress)
    certificate = None
    if not (arguments.no_certify or run.sampling()[0].solves_fem):
        certificate = certify_and_keep(
            posterior, folder, load_steps=run.load_steps, progress=progress
        )
    result = report(run, posterior, certificate)
    emit(arguments, result, f"{posterior_summary(result)}\n{_written(arguments.out)}")
    return DONE if certificate is None or certificate.verdict == "accepted" else FAILED


def _infer_members(arguments: argparse.Namespace, plan: Members, folder: Path) -> int:
    from calibrate.project.members import infer_members, members_report

    hierarchy, verdicts = infer_members(
        plan,
        folder,
        certify=not arguments.no_certify,
        force=arguments.force,
        progress=show_progress(arguments),
    )
    result = members_report(hierarchy, verdicts)
    emit(arguments, result, f"{members_summary(result)}\n{_written(folder)}")
    valid = all(verdict in ("accepted", "decided by FEM") for verdict in verdicts.values())
    return DONE if valid else FAILED


def _written(folder: str | Path) -> str:
    return f"written to {folder}; its page: calibrate report {folder}"


def add_certify(commands: Any) -> None:
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
    add_load_steps(parser, default=None)
    parser.add_argument(
        "--reweight", metavar="DIR2", help="write FEM's posterior, reweighted from the check, there"
    )
    add_scheduler(parser, "the FEM runs")
    answer(parser, run_certify)


def run_certify(arguments: argparse.Namespace) -> int:
    """Check a posterior against FEM; one that was reweighted and saved is a success, too."""
    from calibrate.project import certify_and_keep, read_posterior, report

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
    run, posterior = read_posterior(arguments.folder)
    certificate = certify_and_keep(
        posterior,
        arguments.folder,
        draws=arguments.draws,
        at_most=at_most,
        mesh=0 if arguments.no_mesh else arguments.mesh_runs,
        load_steps=run.load_steps if arguments.load_steps is None else arguments.load_steps,
        reweight_to=arguments.reweight,
        scheduler=scheduler,
        progress=progress,
    )
    result = report(run, posterior, certificate)
    emit(arguments, result, posterior_summary(result))
    reweighted = arguments.reweight is not None and certificate.verdict == "reweight"
    return DONE if reweighted or certificate.verdict == "accepted" else FAILED


def add_report(commands: Any) -> None:
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
    answer(parser, run_report)


def run_report(arguments: argparse.Namespace) -> int:
    """Write the page."""
    if arguments.out and not arguments.out.endswith(".html"):
        raise InputError(f"--out {arguments.out}: the file name must end in .html")
    with needing_plotly("a report needs"):
        from calibrate.report import write_report
    path = write_report(arguments.folder, arguments.out, fem=not arguments.no_fem)
    emit(arguments, {"out": str(path)}, f"written to {path}")
    return DONE


def add_compare(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "compare", help="which of several models predicts the same data better"
    )
    parser.add_argument("folders", metavar="DIR", nargs="+", help="of calibrate infer")
    answer(parser, run_compare)


def run_compare(arguments: argparse.Namespace) -> int:
    """Compare the models of the posteriors in several folders."""
    from calibrate.posterior import read_tree
    from calibrate.posterior.comparison import compare
    from calibrate.project.results import POSTERIOR

    if len(set(arguments.folders)) < len(arguments.folders):
        raise InputError("compare: a folder is given twice; give each model once")
    comparison = compare(
        {folder: read_tree(Path(folder) / POSTERIOR) for folder in arguments.folders}
    )
    report = {**asdict(comparison), "verdict": comparison.verdict}
    emit(arguments, report, comparison_summary(comparison))
    return DONE


def comparison_summary(comparison: Comparison) -> str:
    """Return table and verdict as text."""
    header = ["model", "elpd", "less the best", "+-", "weight", "parameters"]
    has_evidence = any(model.log_evidence is not None for model in comparison.models)
    rows = []
    for model in comparison.models:
        row: list[object] = [
            model.name, model.elpd, model.difference, model.difference_se, model.weight,
            model.parameters,
        ]  # fmt: skip
        if has_evidence:
            row += [model.log_evidence, model.log_evidence_error]
        rows.append(row)
    lines = [table((*header, *(("log evidence", "+-") if has_evidence else ())), rows)]
    lines.append(f"leave-one-out over {comparison.data} data: {comparison.verdict}")
    return "\n".join(lines)


def add_demo(commands: Any) -> None:
    """Add the command."""
    from calibrate.project.demo import DEMOS

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
    answer(parser, run_demo)


def run_demo(arguments: argparse.Namespace) -> int:
    """Run the demo and print its report."""
    from calibrate.project.demo import run_demo

    start = time.perf_counter()
    report = run_demo(arguments.out, arguments.scene, progress=show_progress(arguments))
    report["seconds"] = round(time.perf_counter() - start, 1)
    report["files"] = [
        f"{arguments.out}/{name}"
        for name in ("posterior.nc", "certificate.json", report.pop("picture"))
    ]
    lines = [posterior_summary(report)]
    if "identifiability" in report:
        from calibrate.analysis.identifiability import in_words

        lines.append(in_words(report["identifiability"]))
    lines.append(f"written: {', '.join(report['files'])} ({report['seconds']:.0f} s)")
    emit(arguments, report, "\n".join(lines))
    return DONE if report["verdict"] == "accepted" else FAILED
