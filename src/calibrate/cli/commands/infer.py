"""``calibrate infer``."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import DONE, FAILED, emit, show_progress
from calibrate.cli.model_words import add_model, plan_of
from calibrate.cli.posterior_table import cohort_summary, summary
from calibrate.samplers import SAMPLERS, find_sampler
from emulator.core.errors import InputError

if TYPE_CHECKING:
    from calibrate.project import Run
    from calibrate.project.experiment import Cohort


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "infer",
        help="sample a posterior",
        epilog="examples: calibrate infer SCENE --data measured.csv --noise 0.2 --out DIR; "
        "calibrate infer experiment.toml --out DIR",
    )
    add_model(parser)
    parser.add_argument("--sampler", choices=tuple(SAMPLERS), help="default nuts")
    parser.add_argument(
        "--sampler-options",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="e.g. target_accept=0.95, start=pathfinder; an unknown name lists those there are",
    )
    parser.add_argument("--draws", type=int, help="of each chain (default 1000)")
    parser.add_argument("--warmup", type=int, help="iterations that adapt (default 500)")
    parser.add_argument("--chains", type=int, help="default 4")
    parser.add_argument("--seed", type=int, help="default 0")
    parser.add_argument(
        "--no-certify", action="store_true", help="leave the check against FEM for later"
    )
    parser.add_argument("--out", required=True, metavar="DIR")
    parser.add_argument(
        "--force", action="store_true", help="replace the results of an earlier run in DIR"
    )


def sampler_options(words: list[str]) -> dict[str, Any]:
    """Options by name; a value is a whole number, a number or a word, as it reads."""
    found: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not (name and equals and text):
            raise InputError(
                f"--sampler-options: '{word}' is not NAME=VALUE, as target_accept=0.95"
            )
        found[name] = text
        for kind in (float, int):  # the last that reads it
            with suppress(ValueError):
                found[name] = kind(text)
    return found


def check_warmup(sampler: str, given: int | None) -> None:
    """:class:`InputError` where iterations that adapt are given to a sampler without any."""
    if given is not None and "warmup" not in {
        f.name for f in fields(find_sampler(sampler).options)
    }:
        raise InputError(f"--warmup has no effect with sampler '{sampler}', which does not adapt")


def run(arguments: argparse.Namespace) -> int:
    """Sample and keep a posterior, or those of members of a population."""
    from calibrate.project import Run
    from emulator.core.store import check_folder

    folder = check_folder(arguments.out)
    plan = plan_of(
        arguments,
        sampler=arguments.sampler,
        sampler_options=sampler_options(arguments.sampler_options) or None,
        warmup=arguments.warmup,
        draws=arguments.draws,
        chains=arguments.chains,
        seed=arguments.seed,
    )
    if not isinstance(plan, Run):
        return _run_cohort(arguments, plan, folder)
    check_warmup(plan.sampler, arguments.warmup)
    return _run_one(arguments, plan, folder)


def _run_one(arguments: argparse.Namespace, plan: Run, folder: Path) -> int:
    from calibrate.project import certify_and_keep, report
    from calibrate.project import infer as run_inference

    progress = show_progress(arguments)
    posterior = run_inference(plan, folder, force=arguments.force, progress=progress)
    certificate = None
    if not (arguments.no_certify or find_sampler(plan.sampler).solves_fem):
        certificate = certify_and_keep(
            posterior, folder, load_steps=plan.load_steps, progress=progress
        )
    result = report(plan, posterior, certificate)
    text = (
        f"{summary(result)}\nwritten to {arguments.out}; its page: calibrate report {arguments.out}"
    )
    emit(result, as_json=arguments.json, text=text)
    return DONE if certificate is None or certificate.verdict == "accepted" else FAILED


def _run_cohort(arguments: argparse.Namespace, plan: Cohort, folder: Path) -> int:
    from calibrate.project.cohort import cohort_report, infer_cohort

    found, verdicts = infer_cohort(
        plan,
        folder,
        certify=not arguments.no_certify,
        force=arguments.force,
        progress=show_progress(arguments),
    )
    result = cohort_report(found, verdicts)
    text = f"{cohort_summary(result)}\nwritten to {folder}; its page: calibrate report {folder}"
    emit(result, as_json=arguments.json, text=text)
    good = all(verdict in ("accepted", "decided by FEM") for verdict in verdicts.values())
    return DONE if good else FAILED
