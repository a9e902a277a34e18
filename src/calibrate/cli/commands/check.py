"""``calibrate check`` and ``verify``: checks of a model, of its mesh, and of the mechanics."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.output import DONE, FAILED, emit, show_progress, table
from calibrate.cli.words import (
    add_scene,
    add_scheduler,
    add_theta,
    answer,
    scene_of,
    scheduler_word,
    theta_by_name,
    theta_of,
)
from emulator.core.errors import InputError
from emulator.core.store import check_folder, write_json

if TYPE_CHECKING:
    from calibrate.posterior.klotz_band import KlotzBand
    from calibrate.statistical_model import Model
    from emulator.verify import Benchmark


def add_check(commands: Any) -> None:
    """Add the command and its kinds of checks."""
    from calibrate.cli.run_words import add_run

    parser = commands.add_parser("check", help="whether a model and its sampler can be trusted")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    sbc = kinds.add_parser(
        "sbc", help="simulation-based calibration: posteriors of many synthetic data sets"
    )
    prior = kinds.add_parser("prior", help="what the prior predicts: 500 data sets and a picture")
    for kind, run in ((sbc, run_sbc), (prior, run_prior)):
        add_run(kind, ("seed",))
        kind.add_argument("--out", required=True, metavar="DIR")
        answer(kind, run)
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
    _add_mesh(kinds)
    sbc.add_argument("--warmup", type=int, default=200)
    sbc.add_argument("--draws", type=int, default=250)
    sbc.add_argument("--chains", type=int, default=2)


def _add_mesh(kinds: Any) -> None:
    mesh = kinds.add_parser(
        "mesh", help="shapes of its elements, and how far it is from a finer one"
    )
    add_scene(mesh)
    add_theta(mesh)
    mesh.add_argument(
        "--observe",
        metavar="WHAT",
        help="errors of these observations, as for infer, e.g. landmarks:24+volume (default: "
        "displacements, and the cavity's volume if there is one)",
    )
    mesh.add_argument("--seed", type=int, default=0, help="of random landmarks")
    mesh.add_argument("--out", metavar="DIR", help="write mesh_error.json and a picture")
    answer(mesh, run_mesh)


def run_mesh(arguments: argparse.Namespace) -> int:
    """Print the error of the mesh at one theta, in displacements and in observations."""
    import numpy as np

    from calibrate.measurements.outputs import mesh_errors
    from emulator.accuracy.mesh_error import mesh_error
    from emulator.geometry.quality import mesh_quality

    folder = None if arguments.out is None else check_folder(arguments.out)
    scene = scene_of(arguments)
    theta = theta_of(arguments, scene)
    quality = mesh_quality(scene.mesh)
    error_of_mesh = mesh_error(scene)
    error = error_of_mesh(theta)
    rows = mesh_errors(error_of_mesh, error, arguments.observe, arguments.seed)
    length = np.linalg.norm(error.coarse, axis=1)
    result: dict[str, Any] = {
        "scene": scene.name,
        "theta": theta_by_name(scene, theta),
        "nodes": len(scene.mesh.nodes),
        "quality": quality._asdict(),
        "finer_nodes": len(error_of_mesh.finer.scene.mesh.nodes),
        "err_u": {"median": float(np.median(error.err_u)), "max": float(np.max(error.err_u))},
        "displacement": {"median": float(np.median(length)), "max": float(length.max())},
        "observations": rows,
    }
    header = ("observed", "on the mesh", "error of the mesh", "%")
    cells = [
        (f"{name} ({row['unit']})", row["value"], row["error"], 100.0 * row["relative"])
        for name, row in rows.items()
    ]
    text = (
        f"{scene.name}: {result['nodes']} nodes, beside {result['finer_nodes']} on a finer mesh of "
        f"the same body\n{quality.sentence()}\n"
        f"displacement: off by {result['err_u']['median']:.3g} mm (median of the "
        f"nodes), {result['err_u']['max']:.3g} mm at most, of {result['displacement']['max']:.4g}\n"
        + table(header, cells)
    )
    if folder is not None:
        from calibrate.figures.drawing import save
        from calibrate.figures.evaluation import surface_figure

        write_json(folder / "mesh_error.json", result)
        title = f"{scene.name}: error of a mesh of {result['nodes']} nodes"
        label = "displacement less that on a finer mesh (mm)"
        figure = surface_figure(scene.mesh, np.asarray(error.err_u), title, label)
        save(figure, folder / "mesh_error.png")
        text += f"\nwritten to {folder}"
    emit(arguments, result, text)
    return DONE


def run_sbc(arguments: argparse.Namespace) -> int:
    """Calibrate many synthetic data sets, and print how often intervals cover the truth."""
    from calibrate.analysis.sbc import sbc
    from calibrate.cli.run_words import noise_words, problem_of
    from calibrate.figures.sensitivity import draw_calibration
    from calibrate.project import by_fem, model_before_data
    from calibrate.samplers import NUTSOptions

    folder, progress = check_folder(arguments.out), show_progress(arguments)
    if arguments.scheduler is not None and not arguments.fem_data:
        raise InputError("--scheduler has no effect without --fem-data")
    scheduler = scheduler_word(arguments)
    problem = problem_of(arguments, ("seed",))
    run, model = problem.run, model_before_data(problem, progress=progress)
    truth = model
    if arguments.true_noise:
        truth = model_before_data(problem.change(noise=noise_words(arguments.true_noise)))
    if arguments.fem_data:
        truth = by_fem(truth, run.load_steps)
    options = NUTSOptions(arguments.warmup, arguments.draws, arguments.chains, rounds=1)
    calibration = sbc(
        model,
        arguments.replicates,
        truth=truth,
        options=options,
        seed=run.seed,
        progress=progress,
        scheduler=scheduler,
    )
    result = calibration.to_json()
    write_json(folder / "calibration.json", result)
    draw_calibration(calibration, f"{run.scene}, {run.forward}", folder / "calibration.png")
    rows = [
        (name, *(f"{100 * share[0]:.0f}" for share in levels.values()), calibration.outside()[name])
        for name, levels in calibration.coverage().items()
    ]
    header = ("quantity", "50 %", "80 %", "90 %", "95 %", "outside band")
    verdict = "calibrated" if calibration.passed else "NOT calibrated"
    verdict = f"{calibration.replicates} data sets: {verdict}"
    emit(arguments, result, f"{table(header, rows)}\n{verdict}\nwritten to {folder}")
    return DONE if calibration.passed else FAILED


def run_prior(arguments: argparse.Namespace) -> int:
    """Draw data sets that the prior predicts, print their quantiles and write a picture."""
    import jax
    import numpy as np

    from calibrate.cli.run_words import problem_of
    from calibrate.figures.sensitivity import draw_prior_predictive
    from calibrate.measurements.volume import in_mmhg
    from calibrate.posterior.predictions import prior_replicates
    from calibrate.project import model_before_data
    from emulator.core.store import save_arrays

    folder: Path = check_folder(arguments.out)
    problem = problem_of(arguments, ("seed",))
    run, model = problem.run, model_before_data(problem, progress=show_progress(arguments))
    replicates = prior_replicates(model, jax.random.key(run.seed))
    units = {name: part.unit for name, part in model.observe.parts.items()}
    save_arrays(folder / "prior_predictive.safetensors", {**replicates.draws, **replicates.data})
    title = f"{run.scene}: what the prior predicts"
    draw_prior_predictive(replicates.data, units, title, folder / "prior_predictive.png")
    result: dict[str, Any] = {
        name: dict(zip(("5 %", "50 %", "95 %"), np.quantile(v, [0.05, 0.5, 0.95]), strict=True))
        for name, v in replicates.data.items()
    }
    rows = [(f"{name} ({units[name]})", *quantiles.values()) for name, quantiles in result.items()]
    text = table(("observation", "5 %", "50 %", "95 %"), rows)
    if (band := _klotz(model, run.seed)) is not None:
        result["klotz"] = {"fraction": band.fraction, "band_kpa": band.band}
        text += (
            f"\n{100.0 * band.fraction:.0f} % of {band.apart.size} pressure-volume curves lie "
            f"within {in_mmhg(band.band)} of Klotz's relation through their own last point"
        )
    text += f"\nwritten to {folder}"
    emit(arguments, result, text)
    return DONE


def _klotz(model: Model, seed: int) -> KlotzBand | None:
    """Return the share of the prior's pressure-volume curves in the band of Klotz's relation.

    None without a resting cavity whose pressure varies, and where each prediction is a FEM solve.
    """
    from calibrate.measurements.klotz import klotz_of
    from calibrate.measurements.volume import pressure_volume
    from calibrate.posterior.klotz_band import klotz_band
    from emulator.surrogates.protocol import SolvingMap

    if isinstance(model.forward, SolvingMap) or (curve := pressure_volume(model.full)) is None:
        return None
    if klotz_of(model.forward.scene, curve.rest, curve.pressures[-1]) is None:
        return None
    return klotz_band(model, seed=seed)


def add_verify(commands: Any) -> None:
    """Add the command."""
    from emulator.verify import CASES

    parser = commands.add_parser(
        "verify",
        help="measured / reference / tolerance tables",
        description="Check the mechanics against closed forms, benchmarks and released solutions.",
        epilog=f"Cases: {', '.join(CASES)} (all of them by default); or 'published DIR', FEM "
        "against the released FEniCS solutions in DIR.",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; 'published DIR'")
    answer(parser, run_verify)


def run_verify(arguments: argparse.Namespace) -> int:
    """Print the table; the exit code says whether every row is inside its tolerance."""
    rows = _rows(arguments.names)
    text = table(
        ("name", "measured", "reference", "tolerance", "passed"),
        [(r.name, r.measured, r.reference, r.tolerance, "yes" if r.passed else "NO") for r in rows],
    )
    failed = sum(not row.passed for row in rows)
    text += f"\n{len(rows)} rows, {failed or 'none'} outside the tolerance"
    emit(arguments, [row.to_json() for row in rows], text)
    return FAILED if failed else DONE


def _rows(names: list[str]) -> list[Benchmark]:
    """Return the rows of the cases called ``names``, or of all."""
    from emulator.verify import CASES, verify_published

    if names and names[0] == "published":
        if len(names) != 2:
            raise InputError("verify published: give the folder of the released data, and only it")
        from emulator.released.scenes import MODELS, models_in

        rows = verify_published(names[1])
        absent = sorted(set(MODELS) - set(models_in(names[1])))
        if absent:
            print(f"not in {names[1]}: {', '.join(absent)}", file=sys.stderr, flush=True)
        return rows
    for name in names:
        if name not in CASES:
            known = ", ".join([*CASES, "published DIR"])
            raise InputError(f"verify: case '{name}' is unknown; known: {known}")
    rows = []
    for name in names or CASES:
        start = time.perf_counter()
        rows += CASES[name]()
        print(f"{name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    return rows
