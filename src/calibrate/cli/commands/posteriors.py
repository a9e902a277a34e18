"""``calibrate infer``, ``certify``, ``report``, ``compare`` and ``demo``: posteriors in folders."""

from __future__ import annotations

import math
import sys
import time
from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from calibrate.cli import words
from calibrate.cli.output import check_plotly, members_summary, posterior_summary, table
from calibrate.cli.run_words import run_options
from calibrate.cli.words import Answer, command, flag, option, seconds
from emulator.core.errors import InputError
from emulator.core.rooms import offered
from emulator.core.store import check_folder

if TYPE_CHECKING:
    from calibrate.posterior.comparison import Comparison
    from calibrate.project.members import Members


@command(
    run_options("sampler", "sampler_options", "warmup", "draws", "chains", "seed"),
    option(
        "others",
        "SCENE",
        "the same body or test by other laws: each goes into a folder of its name in DIR, and they "
        "are compared",
        nargs="*",
    ),
    flag("--no-certify", "leave the check against FEM for later"),
    option(
        "--budget",
        "TIME",
        "time for everything, e.g. 5m: the best posterior by then, and what "
        "FEM says of it; where a scene has no emulator, half of it for rounds of FEM runs",
    ),
    option("--out", "DIR", required=True),
    flag("--force", "replace the results of an earlier run in DIR"),
    help="sample a posterior",
    epilog="examples: calibrate infer SCENE --data measured.csv --noise 0.2 --out DIR; "
    "calibrate infer experiment.toml --out DIR; calibrate infer test_ogden.toml test_yeoh.toml "
    "--out DIR",
)
def infer(arguments: Namespace) -> Answer:
    """Sample and certify a posterior, or those of members or of several laws, and save them."""
    from calibrate.cli.run_words import plan_of
    from calibrate.project import (
        Problem,
        Run,
        by_rounds,
        certify_and_keep,
        infer,
        read_problem,
        report,
    )

    if arguments.others:
        return _infer_several(arguments)
    folder, progress = check_folder(arguments.out), not arguments.json
    plan, force, certify = plan_of(arguments), arguments.force, not arguments.no_certify
    begin = time.perf_counter()
    budget = math.inf if arguments.budget is None else seconds(arguments.budget)
    written = f"written to {arguments.out}; its page: calibrate report {arguments.out}"
    if not isinstance(plan, Run | Problem):
        return _infer_members(plan, arguments, written)
    problem = by_rounds(read_problem(plan))
    run, (sampler, options) = problem.run, problem.run.sampling()
    if arguments.warmup is not None and not hasattr(options, "warmup"):
        raise InputError(
            f"--warmup has no effect with sampler '{sampler.name}', which does not adapt"
        )
    for long_table in offered("emulator.specimens.specimen", "long_table") if progress else ():
        for note in long_table(problem.scene):
            print(note, file=sys.stderr, flush=True)
    posterior = infer(
        problem,
        folder,
        force=force,
        check_map=not certify,
        deadline=begin + 0.5 * budget,
        progress=progress,
    )
    certificate = None
    if certify:
        certificate = certify_and_keep(
            posterior,
            folder,
            load_steps=run.load_steps,
            executor=run.engine,
            deadline=begin + budget,
            progress=progress,
        )
    result = report(run, posterior, certificate)
    usable = certificate is None or certificate.verdict == "accepted"
    return Answer(result, f"{posterior_summary(result)}\n{written}", usable)


def _infer_several(arguments: Namespace) -> Answer:
    """Sample and certify a posterior by each of several laws, and compare them."""
    from calibrate.cli.run_words import problem_of
    from calibrate.posterior import read_tree
    from calibrate.posterior.comparison import compare, require_same_data
    from calibrate.project.results import POSTERIOR

    scenes = [arguments.scene, *arguments.others]
    budget = arguments.budget and f"{seconds(arguments.budget) / len(scenes):g}s"
    alone = {**vars(arguments), "others": [], "budget": budget}
    runs = {
        name: Namespace(**{**alone, "scene": scene, "out": f"{arguments.out}/{name}"})
        for name, scene in ((Path(scene).stem, scene) for scene in scenes)
    }
    if len(runs) < len(scenes):
        raise InputError("infer: two scenes have one name; each gets a folder of its name")
    check_folder(arguments.out)
    data = {name: problem_of(run).data for name, run in runs.items()}
    measured = {name: values for name, values in data.items() if values is not None}
    if len(measured) < len(data):
        raise InputError("infer: several laws need data that were measured: --data FILE")
    require_same_data(measured)
    answers: dict[str, Answer] = {name: run.run(run) for name, run in runs.items()}
    trees = {run.out: read_tree(Path(run.out) / POSTERIOR) for run in runs.values()}
    comparison = compare(trees)
    result = {
        "runs": {name: answer.result for name, answer in answers.items()},
        "comparison": {**asdict(comparison), "verdict": comparison.verdict},
    }
    texts = [f"{name}\n{answer.text}\n" for name, answer in answers.items()]
    then = f"calibrate predict {' '.join(trees)} --scene OTHER mixes them"
    text = "\n".join([*texts, comparison_summary(comparison), then])
    return Answer(result, text, all(answer.usable for answer in answers.values()))


def _infer_members(plan: Members, arguments: Namespace, written: str) -> Answer:
    """Sample the members of a population, each by itself and all together; ``written`` ends it."""
    from calibrate.project.members import infer_members, members_report  # a room

    if arguments.budget is not None:
        raise InputError("--budget is of one run; members of a population take their time")
    hierarchy, verdicts = infer_members(
        plan,
        Path(arguments.out),
        certify=not arguments.no_certify,
        force=arguments.force,
        progress=not arguments.json,
    )
    result = members_report(hierarchy, verdicts)
    usable = {*verdicts.values()} <= {"accepted"}
    return Answer(result, f"{members_summary(result)}\n{written}", usable)


def _add_solves(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--draws",
        type=int,
        help="FEM runs (default: 70, or 50 after rounds of FEM runs, doubled up to 200 while the "
        "verdict is undecided)",
    )
    parser.add_argument(
        "--until",
        choices=["decided"],
        help="while the verdict is undecided, double the FEM runs up to --at-most",
    )
    parser.add_argument(
        "--at-most", type=int, metavar="N", help="FEM runs altogether (default 1000)"
    )
    finer = parser.add_mutually_exclusive_group()
    finer.add_argument(
        "--mesh-runs",
        type=int,
        metavar="N",
        help="at most so many solves on the next finer mesh (default: until they decide, 30)",
    )
    finer.add_argument("--no-mesh", action="store_true", help="leave the error of the mesh out")


@command(
    option("folder", "DIR", "written by calibrate infer"),
    _add_solves,
    words.load_steps_option(default=None),
    words.engine_option(),
    option("--reweight", "DIR2", "write FEM's posterior, reweighted from the check, there"),
    help="check a posterior against FEM",
)
def certify(arguments: Namespace) -> Answer:
    """Check a posterior against FEM; one that was reweighted and saved is a success, too."""
    from calibrate.project import certify_and_keep, read_posterior, report

    if arguments.reweight is not None:
        target = check_folder(arguments.reweight)
        if target.resolve() == Path(arguments.folder).resolve():
            raise InputError(f"--reweight {target}: that is DIR itself; name another folder")
    at_most = arguments.at_most
    if arguments.until is not None:
        at_most = 1000 if at_most is None else at_most
    elif at_most is not None:
        raise InputError("--at-most is of --until decided; give both, or --draws")
    run, posterior = read_posterior(arguments.folder)
    certificate = certify_and_keep(
        posterior,
        arguments.folder,
        draws=arguments.draws,
        at_most=at_most,
        mesh=0 if arguments.no_mesh else arguments.mesh_runs,
        load_steps=run.load_steps if arguments.load_steps is None else arguments.load_steps,
        executor=arguments.engine or run.engine,
        reweight_to=arguments.reweight,
        progress=not arguments.json,
    )
    result = report(run, posterior, certificate)
    usable = {"accepted"} if arguments.reweight is None else {"accepted", "reweight"}
    return Answer(result, posterior_summary(result), certificate.verdict in usable)


@command(
    option("folder", "DIR", "of calibrate infer"),
    option("--out", "FILE.html", "where to write it (default DIR/report.html)"),
    flag("--no-fem", "without the FEM solve that shows the map's error"),
    help="one HTML page of a posterior, or of a population, that opens anywhere",
    description="Verdict, data against prediction, parameters, the body in three dimensions "
    "with a slider over draws, what the data determine, and how to repeat it, in one file "
    "that needs no network. Of a population: its medians and spreads, the members beside it, "
    "one not seen, how sampling went, and links to pages of members.",
    epilog="example: calibrate report DIR",
)
def report(arguments: Namespace) -> Answer:
    """Write the page."""
    if arguments.out and not arguments.out.endswith(".html"):
        raise InputError(f"--out {arguments.out}: the file name must end in .html")
    check_plotly("a report")
    from calibrate.report import write_report

    path = write_report(arguments.folder, arguments.out, fem=not arguments.no_fem)
    return Answer({"out": str(path)}, f"written to {path}")


@command(
    option("folders", "DIR", "of calibrate infer", nargs="+"),
    help="which of several models predicts the same data better",
)
def compare(arguments: Namespace) -> Answer:
    """Compare the models of the posteriors in several folders."""
    from calibrate.posterior import read_tree
    from calibrate.posterior.comparison import compare
    from calibrate.project.results import POSTERIOR

    if len(set(arguments.folders)) < len(arguments.folders):
        raise InputError("compare: a folder is given twice; give each model once")
    comparison = compare(
        {folder: read_tree(Path(folder) / POSTERIOR) for folder in arguments.folders}
    )
    result = {**asdict(comparison), "verdict": comparison.verdict}
    return Answer(result, comparison_summary(comparison))


def comparison_summary(comparison: Comparison) -> str:
    """Return table and verdict as text."""
    columns = [
        ("model", "name"), ("elpd", "elpd"), ("less the best", "difference"),
        ("+-", "difference_se"), ("weight", "weight"), ("parameters", "parameters"),
    ]  # fmt: skip
    if any(model.log_evidence is not None for model in comparison.models):
        columns += [("log evidence", "log_evidence"), ("+-", "log_evidence_error")]
    rows = [[getattr(model, name) for _, name in columns] for model in comparison.models]
    verdict = f"leave-one-out over {comparison.data} data: {comparison.verdict}"
    return f"{table([head for head, _ in columns], rows)}\n{verdict}"


def _add_demos(parser: ArgumentParser) -> None:
    from calibrate.project.demo import DEMOS

    parser.add_argument(
        "--scene",
        choices=tuple(DEMOS),
        default=next(iter(DEMOS)),
        help="the beam (default), or the left ventricle from a volume and 24 landmarks, in minutes",
    )


@command(
    _add_demos,
    option("--out", "DIR", default="demo-output"),
    help="the whole job on a built-in beam in under a minute, or on a ventricle",
)
def demo(arguments: Namespace) -> Answer:
    """Run the demo and write its report."""
    from calibrate.project.demo import BEAM, PICTURE, run_demo
    from calibrate.project.results import REPORT

    start, is_beam = time.perf_counter(), arguments.scene == BEAM.scene
    if not is_beam:
        check_plotly("a report")
    result = run_demo(arguments.out, arguments.scene, progress=not arguments.json)
    if not is_beam:
        from calibrate.report import write_report

        write_report(arguments.out)
    result["seconds"] = round(time.perf_counter() - start, 1)
    names = ("posterior.nc", "certificate.json", PICTURE if is_beam else REPORT)
    paths = [f"{arguments.out}/{name}" for name in names]
    result["files"] = [path for path in paths if Path(path).exists()]
    lines = [posterior_summary(result)]
    if "identifiability" in result:
        from calibrate.analysis.identifiability import in_words

        lines.append(in_words(result["identifiability"]))
    lines.append(f"written: {', '.join(result['files'])} ({result['seconds']:.0f} s)")
    return Answer(result, "\n".join(lines), result["verdict"] == "accepted")
