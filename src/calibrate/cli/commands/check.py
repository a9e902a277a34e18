"""``calibrate check`` and ``verify``: checks of a model, of its mesh, and of the mechanics."""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from calibrate.cli import words
from calibrate.cli.output import table
from calibrate.cli.run_words import run_options
from calibrate.cli.words import Answer, command, flag, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder, write_json

if TYPE_CHECKING:
    from calibrate.posterior.predictions import KlotzBand
    from calibrate.statistical_model import Model

_OUT = option("--out", "DIR", required=True)


@command(
    run_options("seed"),
    _OUT,
    words.JSON,
    option("--replicates", "N", "data sets", type=int, default=200),
    flag("--fem-data", "data made by FEM instead of the forward map itself: tests the map too"),
    option(
        "--true-noise",
        "[NAME=]SD",
        "noise of the data, as for --noise, where it is not the model's: the check must fail",
        nargs="+",
        default=[],
    ),
    option("--warmup", type=int, default=200),
    option("--draws", type=int, default=250),
    option("--chains", type=int, default=2),
    help="simulation-based calibration: posteriors of many synthetic data sets",
)
def _sbc(arguments: Namespace) -> Answer:
    """Calibrate many synthetic data sets, and count how often intervals cover the truth."""
    from calibrate.analysis.sbc import sbc
    from calibrate.cli.run_words import noise_words, problem_of
    from calibrate.figures.sensitivity import calibration_figure
    from calibrate.posterior.predictions import shortfall
    from calibrate.project import by_fem, model_before_data
    from calibrate.samplers import AutoOptions

    folder, progress = check_folder(arguments.out), not arguments.json
    problem = problem_of(arguments)
    run, model = problem.run, model_before_data(problem, progress=progress)
    truth = model
    if arguments.true_noise:
        truth = model_before_data(problem.change(noise=noise_words(arguments.true_noise)))
    if arguments.fem_data:
        truth = by_fem(truth, run.load_steps, run.engine)
    options = AutoOptions(arguments.warmup, arguments.draws, arguments.chains, rounds=1)
    calibration = sbc(
        model,
        arguments.replicates,
        truth=truth,
        options=options,
        seed=run.seed,
        progress=progress,
        executor=run.engine,
    )
    result = calibration.to_json()
    write_json(folder / "calibration.json", result)
    calibration_figure(calibration, f"{run.scene}, {run.forward}", folder / "calibration.png")
    rows = [
        (name, *(f"{100 * share[0]:.0f}" for share in levels.values()), calibration.outside()[name])
        for name, levels in calibration.coverage().items()
    ]
    header = ("quantity", "50 %", "80 %", "90 %", "95 %", "outside band")
    verdict = "calibrated" if calibration.passed else "NOT calibrated"
    verdict = f"{calibration.replicates} data sets: {verdict}"
    lines = [verdict, *shortfall(calibration.replicates, arguments.replicates)]
    text = "\n".join([table(header, rows), *lines, f"written to {folder}"])
    return Answer(result, text, calibration.passed)


@command(run_options("seed"), _OUT, help="what the prior predicts: 500 data sets and a picture")
def _prior(arguments: Namespace) -> Answer:
    """Draw data sets that the prior predicts, find their quantiles and write a picture."""
    import jax
    import numpy as np

    from calibrate.cli.run_words import problem_of
    from calibrate.figures.sensitivity import draw_prior_predictive
    from calibrate.measurements.volume import in_mmhg
    from calibrate.posterior.predictions import prior_replicates, shortfall
    from calibrate.project import model_before_data
    from emulator.core.store import save_arrays

    folder = check_folder(arguments.out)
    problem = problem_of(arguments)
    run, model = problem.run, model_before_data(problem, progress=not arguments.json)
    replicates = prior_replicates(model, jax.random.key(run.seed))
    fewer = shortfall(count := len(replicates.draws[model.names[0]]))
    if not count:
        raise InputError(fewer[0])
    units = {name: part.unit for name, part in model.observe.parts.items()}
    save_arrays(folder / "prior_predictive.safetensors", {**replicates.draws, **replicates.data})
    title = f"{run.scene}: what the prior predicts"
    draw_prior_predictive(replicates.data, units, title, folder / "prior_predictive.png")
    result: dict[str, Any] = {
        name: dict(zip(("5 %", "50 %", "95 %"), np.quantile(v, [0.05, 0.5, 0.95]), strict=True))
        for name, v in replicates.data.items()
    }
    rows = [(f"{name} ({units[name]})", *quantiles.values()) for name, quantiles in result.items()]
    text = "\n".join([table(("observation", "5 %", "50 %", "95 %"), rows), *fewer])
    if fewer:
        result["warnings"] = fewer
    if (band := _klotz(model, run.seed)) is not None:
        result["klotz"] = {"fraction": band.fraction, "band_kpa": band.band}
        text += (
            f"\n{100.0 * band.fraction:.0f} % of {band.apart.size} pressure-volume curves lie "
            f"within {in_mmhg(band.band)} of Klotz's relation through their own last point"
        )
    return Answer(result, f"{text}\nwritten to {folder}")


def _klotz(model: Model, seed: int) -> KlotzBand | None:
    """Return the share of the prior's pressure-volume curves in the band of Klotz's relation.

    None without a resting cavity whose pressure varies, and where each prediction is a FEM solve.
    """
    from calibrate.measurements.klotz import klotz_of
    from calibrate.measurements.volume import pressure_volume
    from calibrate.posterior.predictions import klotz_band
    from emulator.scenes.scene import with_mesh
    from emulator.surrogates.fem import FEMForward

    if isinstance(model.forward, FEMForward) or (curve := pressure_volume(model.full)) is None:
        return None
    if klotz_of(with_mesh(model.forward.scene), curve.rest, curve.pressures[-1]) is None:
        return None
    return klotz_band(model, seed=seed)


@command(
    words.add_scene,
    words.THETA,
    option(
        "--observe",
        "WHAT",
        "errors of these observations, as for infer, e.g. landmarks:24+volume (default: "
        "displacements, and the cavity's volume if there is one)",
    ),
    option("--seed", type=int, default=0, help="of random landmarks"),
    option("--out", "DIR", "write mesh_error.json and a picture"),
    help="shapes of its elements, and how far it is from a finer one",
)
def _mesh(arguments: Namespace) -> Answer:
    """Find the error of the mesh at one theta, in displacements and in observations."""
    import numpy as np

    from calibrate.measurements.outputs import mesh_errors
    from emulator.accuracy.mesh_error import mesh_error
    from emulator.fem.outcome import by_name
    from emulator.geometry.discretisation import mesh_quality

    folder = None if arguments.out is None else check_folder(arguments.out)
    scene = words.scene_of(arguments)
    theta = words.theta_of(arguments, scene)
    quality = mesh_quality(scene.mesh)
    error_of_mesh = mesh_error(scene)
    error = error_of_mesh(theta)
    rows = mesh_errors(error_of_mesh, error, arguments.observe, arguments.seed)
    length = np.linalg.norm(error.coarse, axis=1)
    result: dict[str, Any] = {
        "scene": scene.name,
        "theta": by_name(scene, theta),
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
        from calibrate.figures import save
        from calibrate.figures.evaluation import surface_figure

        write_json(folder / "mesh_error.json", result)
        title = f"{scene.name}: error of a mesh of {result['nodes']} nodes"
        label = "displacement less that on a finer mesh (mm)"
        figure = surface_figure(scene.mesh, np.asarray(error.err_u), title, label)
        save(figure, folder / "mesh_error.png")
        text += f"\nwritten to {folder}"
    return Answer(result, text)


check = words.command_of_kinds(
    "whether a model and its sampler can be trusted", sbc=_sbc, prior=_prior, mesh=_mesh
)


def _add_cases(parser: ArgumentParser) -> None:
    from emulator.verify import CASES

    parser.epilog = (
        f"Cases: {', '.join(CASES)} (all of them by default); or 'published DIR', FEM "
        "against the released FEniCS solutions in DIR."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; 'published DIR'")


@command(
    _add_cases,
    help="measured / reference / tolerance tables",
    description="Check the mechanics against closed forms, benchmarks and released solutions.",
)
def verify(arguments: Namespace) -> Answer:
    """Return the table; it may be used where every row is inside its tolerance."""
    from emulator.verify import CASES, verify_published

    names, rows = arguments.names, []
    if names and names[0] == "published":
        if len(names) != 2:
            raise InputError("verify published: give the folder of the released data, and only it")
        from emulator.released.scenes import MODELS, models_in

        rows = verify_published(names[1])
        absent = sorted(set(MODELS) - set(models_in(names[1])))
        if absent:
            print(f"not in {names[1]}: {', '.join(absent)}", file=sys.stderr, flush=True)
        names = ()
    elif not names:
        names = CASES
    for name in names:
        if name not in CASES:
            known = ", ".join([*CASES, "published DIR"])
            raise InputError(f"verify: case '{name}' is unknown; known: {known}")
    for name in names:
        start = time.perf_counter()
        rows += CASES[name]()
        print(f"{name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    text = table(
        ("name", "measured", "reference", "tolerance", "passed"),
        [(r.name, r.measured, r.reference, r.tolerance, "yes" if r.passed else "NO") for r in rows],
    )
    failed = sum(not row.passed for row in rows)
    text += f"\n{len(rows)} rows, {failed or 'none'} outside the tolerance"
    return Answer([row.to_json() for row in rows], text, not failed)
