"""``calibrate demo``, ``infer`` and ``certify``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from calibrate.cli.common import (
    DONE,
    FAILED,
    add_json,
    add_scene,
    assignments,
    emit,
    show_progress,
    table,
)

# Named here too, so that --help needs no imports; a test compares them with calibrate.demo.DEMOS.
_DEMOS = ("once_clamped_beam", "left_ventricle")
_FORWARDS = ("emulator", "corrected", "reduced", "fem")


def register(commands: Any) -> None:
    """Add the commands."""
    parser = commands.add_parser(
        "demo", help="the whole job on a built-in beam in under a minute, or on a ventricle"
    )
    parser.add_argument(
        "--scene",
        choices=_DEMOS,
        default=_DEMOS[0],
        help="the beam (default), or the left ventricle from a volume and 24 landmarks, in minutes",
    )
    parser.add_argument("--out", default="demo-output", metavar="DIR")
    add_json(parser)
    parser.set_defaults(run=demo)

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
    parser.add_argument("--sampler", choices=("nuts",), default="nuts")
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--warmup", type=int, default=500)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--no-certify", action="store_true", help="leave the check against FEM for later"
    )
    parser.add_argument("--out", required=True, metavar="DIR")
    add_json(parser)
    parser.set_defaults(run=infer)

    parser = commands.add_parser("certify", help="check a posterior against FEM")
    parser.add_argument("folder", metavar="DIR", help="written by calibrate infer")
    parser.add_argument("--draws", type=int, default=200, help="FEM runs")
    add_json(parser)
    parser.set_defaults(run=certify)


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


def demo(arguments: argparse.Namespace) -> int:
    """Run the demo and show what came out."""
    import time

    started = time.perf_counter()
    from calibrate.demo import demo as run_demo

    report = run_demo(arguments.out, arguments.scene, progress=show_progress(arguments))
    report["seconds"] = round(time.perf_counter() - started, 1)
    report["files"] = [
        f"{arguments.out}/{name}"
        for name in ("posterior.nc", "certificate.json", report.pop("picture"))
    ]
    lines = [summary(report)]
    if "identifiability" in report:
        from calibrate.identifiability import in_words

        lines.append(in_words(report["identifiability"]))
    lines.append(f"written: {', '.join(report['files'])} ({report['seconds']:.0f} s)")
    text = "\n".join(lines)
    emit(report, as_json=arguments.json, text=text)
    return DONE if report["verdict"] == "accepted" else FAILED


def infer(arguments: argparse.Namespace) -> int:
    """Sample and keep a posterior."""
    from calibrate.run import Run, certify_and_keep, report
    from calibrate.run import infer as run_inference
    from emulator.store import check_folder

    folder, progress = check_folder(arguments.out), show_progress(arguments)
    run = Run(
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
    posterior = run_inference(run, folder, progress=progress)
    certificate = None
    if not arguments.no_certify:
        certificate = certify_and_keep(posterior, folder, progress=progress)
    result = report(run, posterior, certificate)
    text = f"{summary(result)}\nwritten to {arguments.out}"
    emit(result, as_json=arguments.json, text=text)
    return DONE if certificate is None or certificate.verdict == "accepted" else FAILED


def _absolute(word: str, *, is_path: bool = True) -> str:
    """A path that still means the same from another folder, kept results being read from any."""
    return str(Path(word).resolve()) if is_path else word


def _emulator(word: str | None) -> str | None:
    from emulator.network import shipped

    return word if word is None or word in shipped() else _absolute(word)


def certify(arguments: argparse.Namespace) -> int:
    """Check a kept posterior against FEM."""
    from calibrate.run import certify_and_keep, read_posterior, report

    progress = show_progress(arguments)
    run, posterior = read_posterior(arguments.folder, progress=progress)
    certificate = certify_and_keep(
        posterior, arguments.folder, draws=arguments.draws, progress=progress
    )
    result = report(run, posterior, certificate)
    emit(result, as_json=arguments.json, text=summary(result))
    return DONE if certificate.verdict == "accepted" else FAILED


def summary(report: dict[str, Any]) -> str:
    """The parameter table and the verdict for people."""
    parameters = report["parameters"]
    columns = ["mean", "sd", "low", "high", "r_hat", "ess_bulk"]
    titles = ["mean", "sd", "5 %", "95 %", "R-hat", "ESS"]
    if any("truth" in row for row in parameters.values()):
        columns, titles = ["truth", *columns], ["truth", *titles]
    shift = report.get("certificate", {}).get("shift")
    rows = []
    for name, row in parameters.items():
        cells: list[object] = [row.get(column) for column in columns]
        rows.append((name, *cells, *([shift[name]] if shift else [])))
    lines = [table(("parameter", *titles, *(["FEM shift / sd"] if shift else [])), rows)]
    lines.append(
        f"{report['chains']} chains x {report['draws']} draws, {report['divergences']} divergences"
        f", forward map: {report['forward']}"
    )
    if "certificate" not in report:
        lines.append("not checked against FEM yet: calibrate certify")
    else:
        c = report["certificate"]
        lines.append(
            f"verdict: {report['verdict']} (Pareto k {c['k_hat']:.2f}, "
            f"at most {c['k_threshold']:.2f}; {c['draws']} FEM runs, {c['failed']} failed): "
            f"{c['reason']}"
        )
    return "\n".join(lines)
