"""``calibrate infer``."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path
from typing import Any

from calibrate.cli.common import DONE, FAILED, add_json, add_scene, assignments, emit, show_progress
from calibrate.cli.forward import add_forward, forward_options
from calibrate.cli.noise_words import discrepancy_words, noise_scale_words, noise_words
from calibrate.cli.posterior_table import summary
from calibrate.samplers import SAMPLERS, find_sampler
from emulator.errors import InputError


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("infer", help="sample a posterior")
    add_scene(parser)
    parser.add_argument(
        "--data", default="synthetic", metavar="FILE|synthetic", help=".csv or netCDF, mm and mL"
    )
    parser.add_argument(
        "--truth",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="of synthetic data; NAME@STATE=VALUE in one of several load states",
    )
    parser.add_argument(
        "--known",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="parameters that are not inferred, e.g. pressure@p8=1.07",
    )
    parser.add_argument(
        "--observe",
        default="nodes:20",
        metavar="WHAT",
        help="of synthetic data, e.g. nodes:N, landmarks:N, all, a node set, 3,14,15, volume, "
        "volume:FACETSET, surface:FACETSET:N, strain:fibre:N, segment_strain:circumferential, "
        "length:A:B, parameter:NAME; several joined by +, as in landmarks:24+volume",
    )
    _add_noise(parser)
    add_forward(parser)
    parser.add_argument(
        "--emulator", metavar="NAME|DIR", help="default: the one shipped for the scene"
    )
    parser.add_argument(
        "--error-runs",
        type=int,
        default=0,
        metavar="N",
        help="FEM runs (8 or more) from which the forward map's own error is learned, so that a "
        "poor map widens the posterior instead of moving it",
    )
    parser.add_argument("--sampler", choices=tuple(SAMPLERS), default="nuts")
    parser.add_argument(
        "--sampler-options",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="e.g. target_accept=0.95, start=pathfinder; an unknown name lists those there are",
    )
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--warmup", type=int, default=500)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--no-certify", action="store_true", help="leave the check against FEM for later"
    )
    parser.add_argument("--out", required=True, metavar="DIR")
    add_json(parser)
    parser.set_defaults(run=run)


def _add_noise(parser: argparse.ArgumentParser) -> None:
    """Noise by observation, known or to be inferred, and the check of the data's unit."""
    parser.add_argument(
        "--noise",
        nargs="+",
        default=[],
        metavar="[NAME=]SD",
        help="standard deviation by observation, e.g. volume=1.0 displacement=0.2, mL and mm; a "
        "bare number is a single observation's or the displacements' (default 0.2 mm, 1 mL). Other "
        "noise by its name, e.g. displacement=student_t:dof=4,scale=0.2 or "
        "displacement=correlated:length=15,sd=0.1,spatial_sd=0.2 (length in mm)",
    )
    parser.add_argument(
        "--noise-scale",
        nargs="+",
        default=[],
        metavar="[NAME=]SCALE",
        help="infer the noise: scale of the half-normal prior of its standard deviation",
    )
    parser.add_argument(
        "--discrepancy",
        nargs="+",
        default=[],
        metavar="NAME=SCALE:LENGTH",
        help="let the model be wrong, e.g. displacement=0.5:20: scale of the half-normal prior of "
        "the discrepancy's standard deviation, in the data's unit, and its correlation length, mm",
    )
    parser.add_argument(
        "--no-unit-check",
        action="store_true",
        help="take data however far from every prediction (m for mm, mm3 for mL, zero)",
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


def run(arguments: argparse.Namespace) -> int:
    """Sample and keep a posterior."""
    from calibrate.workflow import Run, certify_and_keep, report
    from calibrate.workflow import infer as run_inference
    from emulator.store import check_folder

    folder, progress = check_folder(arguments.out), show_progress(arguments)
    plan = Run(
        scene=_absolute(arguments.scene, is_path=arguments.scene.endswith(".toml")),
        root=arguments.root and _absolute(arguments.root),
        data=_absolute(arguments.data, is_path=arguments.data != "synthetic"),
        truth=assignments(arguments.truth),
        known=assignments(arguments.known),
        observe=arguments.observe,
        noise=noise_words(arguments.noise),
        noise_scale=noise_scale_words(arguments.noise_scale),
        discrepancy=discrepancy_words(arguments.discrepancy),
        check_scale=not arguments.no_unit_check,
        forward=arguments.forward,
        emulator=_emulator(arguments.emulator),
        forward_options=forward_options(arguments),
        error_runs=arguments.error_runs,
        sampler=arguments.sampler,
        sampler_options=sampler_options(arguments.sampler_options),
        warmup=arguments.warmup,
        draws=arguments.draws,
        chains=arguments.chains,
        seed=arguments.seed,
    )
    posterior = run_inference(plan, folder, progress=progress)
    certificate = None
    if not (arguments.no_certify or find_sampler(plan.sampler).solves_fem):
        certificate = certify_and_keep(posterior, folder, progress=progress)
    result = report(plan, posterior, certificate)
    text = f"{summary(result)}\nwritten to {arguments.out}"
    emit(result, as_json=arguments.json, text=text)
    return DONE if certificate is None or certificate.verdict == "accepted" else FAILED


def _absolute(word: str, *, is_path: bool = True) -> str:
    """An absolute path, because a kept run may be read from any folder."""
    return str(Path(word).resolve()) if is_path else word


def _emulator(word: str | None) -> str | None:
    from emulator.surrogates import shipped

    return word if word is None or word in shipped() else _absolute(word)
