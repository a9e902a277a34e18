"""``calibrate check``: whether a model means what it says, before any data."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibrate.cli.common import (
    DONE,
    FAILED,
    add_json,
    add_scheduler,
    emit,
    scheduler_word,
    show_progress,
    table,
)
from calibrate.cli.model_words import add_model, model_of
from calibrate.cli.noise_words import noise_words
from emulator.errors import InputError


def register(commands: Any) -> None:
    """Add the command and its kinds of checks."""
    parser = commands.add_parser("check", help="whether a model and its sampler can be trusted")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    sbc = kinds.add_parser(
        "sbc", help="simulation-based calibration: posteriors of many synthetic data sets"
    )
    prior = kinds.add_parser("prior", help="what the prior predicts: 500 data sets and a picture")
    for kind, run in ((sbc, run_sbc), (prior, run_prior)):
        add_model(kind)
        kind.add_argument("--seed", type=int, default=0)
        kind.add_argument("--out", required=True, metavar="DIR")
        add_json(kind)
        kind.set_defaults(run=run)
    sbc.add_argument("--replicates", type=int, default=200, metavar="N", help="data sets")
    sbc.add_argument(
        "--fem-data",
        action="store_true",
        help="data made by FEM instead of the forward map itself: tests the map too",
    )
    sbc.add_argument(
        "--true-noise",
        nargs="+",
        default=[],
        metavar="[NAME=]SD",
        help="noise of the data, as for --noise, where it is not the model's: the check must fail",
    )
    add_scheduler(sbc, "with --fem-data, the FEM runs")
    sbc.add_argument("--warmup", type=int, default=200)
    sbc.add_argument("--draws", type=int, default=250)
    sbc.add_argument("--chains", type=int, default=2)


def run_sbc(arguments: argparse.Namespace) -> int:
    """Simulation-based calibration of the model."""
    from calibrate.figures.calibration import draw
    from calibrate.run import Run
    from calibrate.samplers import NUTSOptions
    from calibrate.sbc import sbc
    from calibrate.workflow import by_fem, model_before_data
    from emulator.store import check_folder, write_json

    folder, progress = check_folder(arguments.out), show_progress(arguments)
    if arguments.scheduler is not None and not arguments.fem_data:
        raise InputError("--scheduler has no effect without --fem-data")
    scheduler = scheduler_word(arguments)
    run = Run(**model_of(arguments), seed=arguments.seed)
    model = model_before_data(run, progress=progress)
    truth = model
    if arguments.true_noise:
        truth = model_before_data(replace(run, noise=noise_words(arguments.true_noise)))
    if arguments.fem_data:
        truth = by_fem(truth)
    options = NUTSOptions(arguments.warmup, arguments.draws, arguments.chains, rounds=1)
    found = sbc(
        model,
        arguments.replicates,
        truth=truth,
        options=options,
        seed=arguments.seed,
        progress=progress,
        scheduler=scheduler,
    )
    result = found.to_json()
    write_json(folder / "calibration.json", result)
    draw(found, f"{run.scene}, {run.forward}", folder / "calibration.png")
    rows = [
        (name, *(f"{100 * covered[0]:.0f}" for covered in by.values()), found.outside()[name])
        for name, by in found.coverage().items()
    ]
    header = ("quantity", "50 %", "80 %", "90 %", "95 %", "outside band")
    verdict = "calibrated" if found.passed else "NOT calibrated"
    text = f"{table(header, rows)}\n{found.replicates} data sets: {verdict}\nwritten to {folder}"
    emit(result, as_json=arguments.json, text=text)
    return DONE if found.passed else FAILED


def run_prior(arguments: argparse.Namespace) -> int:
    """Data sets that the prior predicts, and their picture."""
    import jax
    import numpy as np

    from calibrate.figures.calibration import draw_prior_predictive
    from calibrate.predictions import prior_replicates
    from calibrate.run import Run
    from calibrate.workflow import model_before_data
    from emulator.store import check_folder, save_arrays

    folder: Path = check_folder(arguments.out)
    run = Run(**model_of(arguments), seed=arguments.seed)
    model = model_before_data(run, progress=show_progress(arguments))
    found = prior_replicates(model, jax.random.key(arguments.seed))
    units = {name: part.unit for name, part in model.observe.parts.items()}
    save_arrays(folder / "prior_predictive.safetensors", {**found.draws, **found.data})
    title = f"{run.scene}: what the prior predicts"
    draw_prior_predictive(found.data, units, title, folder / "prior_predictive.png")
    result = {
        name: dict(zip(("5 %", "50 %", "95 %"), np.quantile(v, [0.05, 0.5, 0.95]), strict=True))
        for name, v in found.data.items()
    }
    rows = [(f"{name} ({units[name]})", *by.values()) for name, by in result.items()]
    text = f"{table(('observation', '5 %', '50 %', '95 %'), rows)}\nwritten to {folder}"
    emit(result, as_json=arguments.json, text=text)
    return DONE
