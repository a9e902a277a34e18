"""``calibrate cohort``: many subjects, each calibrated by itself and then all together."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from calibrate.cli import words
from calibrate.cli.output import members_summary
from calibrate.cli.words import Answer, command, flag, option
from emulator.core.store import check_folder


@command(
    option("subjects", "TABLE|DIR", "a row, or a folder, for each subject"),
    option("--law", "NAME", "law of subjects that are a mesh or a specimen's table"),
    option("--draws", "N", "iterations of each chain that are kept (default 1000)", type=int),
    option("--seed", "N", "of all subjects (default 0)", type=int),
    words.engine_option(),
    flag("--no-certify", "leave the checks against FEM for later"),
    option("--out", "DIR", required=True),
    flag("--force", "replace the results of an earlier cohort in DIR"),
    help="many subjects: a posterior of each, and of their population",
    description="A table has a column subject, and of each subject what its experiment has: "
    "experiment, scene or mesh, data or data:STATE, known:NAME, noise:NAME, group. A folder has "
    "a folder for each subject, with experiment.toml or the table of a test. A subject that "
    "fails is named and left out. The same command, given again, goes on where it stopped.",
    epilog="examples: calibrate cohort subjects.csv --engine processes:2 --out COHORT; "
    "calibrate report COHORT",
)
def cohort(arguments: Namespace) -> Answer:
    """Calibrate every subject, then the population of those that did not fail."""
    from calibrate.project.cohort import read_cohort, with_settings
    from calibrate.project.members import infer_members, members_report

    out = check_folder(arguments.out)
    plan = read_cohort(Path(arguments.subjects), out, arguments.law)
    settings = {name: getattr(arguments, name) for name in ("draws", "seed")}
    plan = with_settings(plan, {n: v for n, v in settings.items() if v is not None})
    hierarchy, verdicts = infer_members(
        plan,
        out,
        certify=not arguments.no_certify,
        force=arguments.force,
        tolerant=True,
        executor=arguments.engine,
        progress=not arguments.json,
    )
    result = members_report(hierarchy, verdicts)
    lines = [members_summary(result)]
    lines += [f"{name} {why}" for name, why in result["failed"].items()]
    lines.append(f"written to {out}; its page: calibrate report {out}")
    return Answer(result, "\n".join(lines), {*verdicts.values()} <= {"accepted"})
