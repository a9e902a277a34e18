"""``calibrate infer``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from calibrate.cli.common import DONE, FAILED, add_json, add_scene, assignments, emit, show_progress
from calibrate.cli.posterior_table import summary

_FORWARDS = ("emulator", "corrected", "reduced", "fem")


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("infer", help="sample a posterior")
    add_scene(parser)
    parser.add_argument(
        "--data", default="synthetic", metavar="FILE|synthetic", help=".csv or netCDF, mm and mL"
    )
    parser.add_argument(
        "--truth", nargs="+", default=[], metavar="NAME=VALUE", help="of synthetic data"
    )
    parser.add_argument(
        "--observe",
        default="nodes:20",
        metavar="WHAT",
        help="of synthetic data: nodes:N, landmarks:N, all, a node set, 3,14,15, volume, "
        "volume:FACETSET; several joined by +, as in landmarks:24+volume",
    )
    _add_noise(parser)
    parser.add_argument("--forward", choices=_FORWARDS, default="emulator")
    parser.add_argument(
        "--emulator", metavar="NAME|DIR", help="default: the one shipped for the scene"
    )
    parser.add_argument(
        "--fem-runs", type=int, default=30, help="that the reduced model is fitted to"
    )
    parser.add_argument("--sampler", default="nuts", metavar="NAME", help="default: nuts")
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
    """Noise of displacements and of volumes, known or to be inferred."""
    for option, quantity, unit, default in (
        ("--noise", "displacements", "MM", 0.2),
        ("--volume-noise", "volumes", "ML", 1.0),
    ):
        parser.add_argument(
            option,
            type=float,
            metavar=unit,
            default=default,
            help=f"standard deviation of {quantity} (default {default})",
        )
        parser.add_argument(
            f"{option}-scale",
            type=float,
            metavar=unit,
            help=f"infer the noise of {quantity}; scale of its half-normal prior",
        )


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
        observe=arguments.observe,
        noise_sd=arguments.noise,
        noise_scale=arguments.noise_scale,
        volume_noise_sd=arguments.volume_noise,
        volume_noise_scale=arguments.volume_noise_scale,
        forward=arguments.forward,
        emulator=_emulator(arguments.emulator),
        fem_runs=arguments.fem_runs,
        sampler=arguments.sampler,
        warmup=arguments.warmup,
        draws=arguments.draws,
        chains=arguments.chains,
        seed=arguments.seed,
    )
    posterior = run_inference(plan, folder, progress=progress)
    certificate = None
    if not arguments.no_certify:
        certificate = certify_and_keep(posterior, folder, progress=progress)
    result = report(plan, posterior, certificate)
    text = f"{summary(result)}\nwritten to {arguments.out}"
    emit(result, as_json=arguments.json, text=text)
    return DONE if certificate is None or certificate.verdict == "accepted" else FAILED


def _absolute(word: str, *, is_path: bool = True) -> str:
    """A path that still means the same from another folder, kept results being read from any."""
    return str(Path(word).resolve()) if is_path else word


def _emulator(word: str | None) -> str | None:
    from emulator.surrogates import shipped

    return word if word is None or word in shipped() else _absolute(word)
