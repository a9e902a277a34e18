"""``calibrate predict``: an emulator at one theta, or a posterior's draws on another scene."""

from __future__ import annotations

import math
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli import words
from calibrate.cli.output import table, volume_lines
from calibrate.cli.words import Answer, command, flag, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder, read_json

if TYPE_CHECKING:
    import jax

    from emulator.accuracy.estimate import ErrorEstimate
    from emulator.scenes import Scene

_ROWS = 24  # numbers of a prediction that a table shows
_OF_POSTERIOR = ("observe", "draws", "most_runs", "load_steps", "seed")  # options beside --scene


@command(
    option("emulator", "EMULATOR|RUN", "shipped name or folder; with --scene, of calibrate infer"),
    words.THETA,
    flag("--error-bar", "estimate the error from the residual forces"),
    option("--scene", "OTHER", "what the draws of RUN predict of this scene or specimen, of the "
           "same law: another body, load or test; --theta has its loads, pressure@p1=0.5"),
    option("--observe", "WORDS", "of OTHER, as of infer: volume, landmarks:24, ..."),
    option("--draws", "N", "of RUN (default 1000)", type=int),
    option("--most-runs", "N", "FEM runs of OTHER at most (default 96)", type=int),
    option("--load-steps", "N", "of FEM of OTHER (default 1)", type=int),
    option("--seed", "N", "of draws and places (default 0)", type=int),
    option("--out", "FILE.vtu|DIR", "write displacement, stress and strain; with --scene draws, "
           "bands and the body"),
    help="an emulator's displacement, or what a posterior predicts of another scene",
    description="Evaluate an emulator at one theta. Exit code 1 says not to trust the result: "
    "theta outside the box, an inverted element, no equilibrium near the prediction. With --scene, "
    "push the draws of a posterior through another scene, by FEM at a few of them.",
    epilog="example: calibrate predict RUN --scene heart.toml --theta pressure@p1=0.5 "
    "pressure@p2=1 --observe volume --out DIR",
)  # fmt: skip
def predict(arguments: Namespace) -> Answer:
    """Predict at one theta, with the guard's verdict, or at the draws of a posterior."""
    if arguments.scene is not None:
        return _on_another_scene(arguments)
    for name in _OF_POSTERIOR:
        if getattr(arguments, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} has no effect without --scene")
    if (Path(arguments.emulator) / "run.json").is_file():
        raise InputError(
            f"{arguments.emulator} is a folder of infer: name the scene that it predicts, --scene"
        )
    return _at_one_theta(arguments)


def _on_another_scene(arguments: Namespace) -> Answer:
    """Predict another scene by the draws of a posterior."""
    from calibrate.measurements import parse_observation
    from calibrate.prediction import output, predict_on
    from calibrate.prediction.beyond import reaches
    from calibrate.prediction.transfer import Learned
    from calibrate.project import holds_population, read_posterior
    from calibrate.project.calibration import NOT_CERTIFIED
    from calibrate.project.results import CERTIFICATE
    from calibrate.state_names import split
    from emulator.catalogue import find_problem

    if arguments.error_bar:
        raise InputError("--error-bar is of an emulator at one theta, without --scene")
    if arguments.observe is None:
        raise InputError("--scene: say what to predict with --observe, e.g. --observe volume")
    folder = None if arguments.out is None else check_folder(arguments.out)
    run, verdict = Path(arguments.emulator), "of members, see calibrate report"
    if holds_population(run):
        learned = Learned.of_population(run)
    else:
        learned = Learned.of(read_posterior(run)[1])
        file = run / CERTIFICATE
        verdict = read_json(file)["verdict"] if file.is_file() else NOT_CERTIFIED
    scene, known = find_problem(arguments.scene), words.assignments(arguments.theta)
    states = tuple(dict.fromkeys(state for _, state in map(split, known) if state)) or ("",)
    seed = 0 if arguments.seed is None else arguments.seed
    observe = parse_observation(scene, arguments.observe, seed, states)
    options = {
        name: value
        for name in ("draws", "most_runs", "load_steps")
        if (value := getattr(arguments, name)) is not None
    }
    progress = not arguments.json
    predicted = predict_on(
        learned, scene, observe, known=known, seed=seed, progress=progress, **options
    )
    reach = reaches(learned, predicted.scene, predicted.forward, observe.states, predicted.thetas)
    result = {"posterior": verdict, **output.as_json(predicted, reach)}
    text = bands_summary(result)
    if folder is not None:
        result["files"] = output.write(predicted, result, folder)
        text += f"\nwritten to {folder}: {', '.join(result['files'])}"
    return Answer(result, text, not predicted.warnings)


def bands_summary(result: dict[str, Any]) -> str:
    """Return :func:`calibrate.prediction.output.as_json` as text."""
    from calibrate.prediction.beyond import Reach

    keys = ("unit", "mean", "sd", "low", "median", "high")
    shown = list(result["numbers"].items())
    rows = [[name, *(row[key] for key in keys)] for name, row in shown[:_ROWS]]
    lines = [table(("prediction", "unit", "mean", "sd", "5 %", "50 %", "95 %"), rows)]
    if len(shown) > _ROWS:
        lines.append(f"and {len(shown) - _ROWS} more numbers")
    by_source: dict[str, list[str]] = {}
    for name, source in result["sources"].items():
        by_source.setdefault(source, []).append(name)
    lines += [f"{', '.join(names)}: {source}" for source, names in by_source.items()]
    lines.append(f"verdict on the posterior: {result['posterior']}")
    others = (
        f"{result['fem_runs']} of them by FEM; others are those of a process, which missed tests "
        f"by {result['missed_sd']:.2g} sd of the draws"
    )
    every = result["fem_runs"] >= result["draws"]
    lines.append(f"{result['draws']} draws, {'each of them solved' if every else others}")
    lines += [str(Reach(**one)) for one in result["beyond"] if one["share"] > 0.0]
    return "\n".join([*lines, *result["warnings"]])


def _at_one_theta(arguments: Namespace) -> Answer:
    """Predict at one theta, with the guard's verdict."""
    import jax
    import numpy as np

    from emulator.accuracy.estimate import guard
    from emulator.fem.outcome import by_name, cavity_volumes, write_outcome
    from emulator.surrogates import load

    if arguments.out:
        words.check_vtu(arguments.out)
    emulator = load(arguments.emulator)
    scene, forward = emulator.scene, emulator.cache()
    values = words.assignments(arguments.theta)
    theta = _anywhere(scene, values) if values else scene.centre
    u = forward(theta)
    estimate, against = None, jax.jit(partial(guard, scene))(theta, u)
    if arguments.error_bar:
        from emulator import Simulator
        from emulator.accuracy.estimate import ErrorBar

        estimate = ErrorBar(forward, Simulator(scene)).of_field(u, theta)
        against = estimate.guard
    finite = bool(against.finite)
    error_of = None if estimate is None or not estimate.valid else estimate.of
    result: dict[str, Any] = {
        "emulator": arguments.emulator,
        "scene": scene.name,
        "theta": by_name(scene, theta),
        "trusted": bool(against.trusted),
        "guard": against.sentence(scene),
        "max_displacement": float(np.linalg.norm(u, axis=1).max()) if finite else None,
        "least_J": float(against.least_J) if finite else None,
        "volumes": cavity_volumes(scene, u, error_of) if finite else {},
        "error": None if estimate is None else _error_of(estimate, scene, theta),
    }
    if arguments.out and finite and against.least_J > 0.0:
        write_outcome(arguments.out, scene, u, theta)
        result["out"] = arguments.out
    return Answer(result, prediction_summary(result), result["trusted"])


def _anywhere(scene: Scene, values: dict[str, float]) -> jax.Array:
    """Return theta (p,) from named finite values, which may lie outside the box."""
    import jax.numpy as jnp

    for name, value in values.items():
        if not math.isfinite(value):
            raise InputError(f"parameter '{name}' is {value}; give a finite number")
    box = {p.name: (p.low, p.high) for p in scene.parameters}
    # The scene refuses missing and unknown names. Values outside the box are allowed here, so they
    # are clipped for this check.
    scene.theta(
        **{n: min(max(v, box[n][0]), box[n][1]) if n in box else v for n, v in values.items()}
    )
    return jnp.array([values[name] for name in scene.parameter_names])


def _error_of(estimate: ErrorEstimate, scene: Scene, theta: jax.Array) -> dict[str, Any]:
    """Return the error bar as plain JSON; without numbers where it is not valid."""
    from emulator.accuracy.comparison import field_errors
    from emulator.fem.reactions import support_forces

    if not estimate.valid:
        return {"valid": False}
    supports = {} if scene.loaded_by else support_forces(scene)
    u, closer = estimate.displacement, estimate.displacement - estimate.field
    errors = field_errors(scene, theta, u, closer, supports=tuple(supports.values()))
    gap, least = float(estimate.energy_gap), float(estimate.least_energy)
    return {
        "valid": True,
        "median_mm": float(estimate.median),
        "mean_mm": float(estimate.mean),
        "max_mm": float(estimate.max),
        "energy_gap": gap,
        "energy_gap_percent": 100.0 * gap / abs(least) if least else None,
        "strain": float(errors["err_E"].max()),
        "reactions_n": dict(zip(supports, map(float, errors.get("err_R", ())), strict=True)),
        "contraction": float(estimate.contraction),
        "iterations": int(estimate.iterations),
    }


def prediction_summary(result: dict[str, Any]) -> str:
    """Return the result as text."""
    largest = result["max_displacement"]
    lines = [
        f"{result['scene']}: largest displacement {largest:.6g} mm"
        if largest is not None
        else f"{result['scene']}: no finite displacement"
    ]
    lines += volume_lines(result["volumes"])
    error = result["error"]
    if error is not None and not error["valid"]:
        lines.append("error: could not be estimated")
    elif error is not None:
        percent = error["energy_gap_percent"]
        gap = "" if percent is None else f"; energy gap {percent:.2g} %"
        lines.append(
            f"estimated error: median {error['median_mm']:.2g} mm, "
            f"largest {error['max_mm']:.2g} mm, {error['strain']:.2g} in strain{gap}"
        )
        lines += [f"force of '{n}': error {e:.2g} N" for n, e in error["reactions_n"].items()]
    if not result["trusted"]:
        lines.append(f"not to be trusted: {result['guard']}")
    return "\n".join(lines)
