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

    from calibrate.prediction import Learned
    from calibrate.prediction.several import Weights
    from emulator.accuracy.estimate import ErrorEstimate
    from emulator.scenes import Scene

_OF_MEMBERS = "of members, see calibrate report"
_ROWS = 24  # numbers of a prediction that a table shows
_OF_POSTERIOR = ("observe", "weights", "another", "draws", "most_runs", "load_steps", "seed")
"""Options beside --scene."""


@command(
    option(
        "emulator",
        "EMULATOR|RUN",
        "shipped name or folder; with --scene, of calibrate infer, or several of the same data by "
        "other laws",
        nargs="+",
    ),
    words.THETA,
    flag("--error-bar", "estimate the error from the residual forces"),
    option("--scene", "OTHER", "what the draws of RUN predict of this scene or specimen, of the "
           "same law: another body, load or test; --theta has its loads, pressure@p1=0.5"),
    option("--observe", "WORDS", "of OTHER, as of infer: volume, landmarks:24, ..."),
    option("--weights", "KIND", "of several RUNs: stacking, which predicts best what was left out "
           "(default), evidence or equal", choices=["stacking", "evidence", "equal"]),
    option("--another", "TISSUE|LOG_SD", "predict another specimen than the one measured: its "
           "stiffness scatters by what is published of a tissue (artery, clot, muscle, myocardium, "
           "rubber, skin), or by this log-sd"),
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
    if len(arguments.emulator) > 1:
        raise InputError("predict: several folders are of posteriors: name a scene, --scene")
    if (Path(arguments.emulator[0]) / "run.json").is_file():
        raise InputError(
            f"{arguments.emulator[0]} is a folder of infer: name the scene that it predicts, "
            "--scene"
        )
    return _at_one_theta(arguments)


def _on_another_scene(arguments: Namespace) -> Answer:
    """Predict another scene by the draws of a posterior, or of several laws'."""
    from calibrate.measurements import parse_observation
    from calibrate.prediction import output, predict_on
    from calibrate.prediction.beyond import how_far_beyond, widened
    from calibrate.prediction.several import mixture, table_of
    from calibrate.prediction.transfer import made_of
    from calibrate.state_names import split
    from emulator.catalogue import find_problem

    if arguments.error_bar:
        raise InputError("--error-bar is of an emulator at one theta, without --scene")
    if arguments.observe is None:
        raise InputError("--scene: say what to predict with --observe, e.g. --observe volume")
    folder = None if arguments.out is None else check_folder(arguments.out)
    runs, several = list(dict.fromkeys(arguments.emulator)), len(arguments.emulator) > 1
    if len(runs) < len(arguments.emulator):
        raise InputError("predict: a folder is given twice; give each posterior once")
    if arguments.weights is not None and not several:
        raise InputError("--weights are of several posteriors; one has all the weight")
    bodies, verdicts, weights = _learned(runs)
    shares = {} if weights is None else weights.by(arguments.weights or "stacking")
    scene, known = find_problem(arguments.scene), words.assignments(arguments.theta)
    states = tuple(dict.fromkeys(state for _, state in map(split, known) if state)) or ("",)
    seed, options = arguments.seed or 0, _options(arguments)
    predictions = {}
    for name, learned in bodies.items():
        of_law = made_of(scene, learned.scene) if several else scene
        observe = parse_observation(of_law, arguments.observe, seed, states)
        predictions[name] = predict_on(
            learned, of_law, observe, known=known, seed=seed, progress=not arguments.json, **options
        )
    chosen, predicted = runs[0], predictions[runs[0]]
    result: dict[str, Any] = {"posterior": verdicts[chosen]}
    if weights is not None:
        chosen, predicted = max(shares, key=lambda n: shares[n]), mixture(predictions, shares, seed)
        predicted.warnings.extend(weights.warnings)
        laws = {name: learned.scene.law.name for name, learned in bodies.items()}
        result = {"posterior": verdicts, "laws": table_of(weights, laws)}
    beyond = how_far_beyond(
        bodies[chosen],
        predicted.scene,
        predicted.forward,
        predicted.observe.states,
        predicted.thetas,
    )
    outer = widened(predicted, beyond, seed)
    result |= output.as_json(predicted, beyond, outer)
    if several:
        result["by_law"] = {name: dict(output.numbers(p)) for name, p in predictions.items()}
    text = bands_summary(result)
    if folder is not None:
        result["files"] = output.write(predicted, beyond, outer, result, folder)
        text += f"\nwritten to {folder}: {', '.join(result['files'])}"
    return Answer(result, text, not predicted.warnings)


def _options(arguments: Namespace) -> dict[str, Any]:
    """Return the options of a prediction that are not left to their defaults."""
    from emulator.scenes.tissue_priors import scatter_of

    names = ("another", "draws", "most_runs", "load_steps")
    options = {name: v for name in names if (v := getattr(arguments, name)) is not None}
    if "another" in options:
        options["another"] = scatter_of(options["another"])
    return options


def _learned(runs: list[str]) -> tuple[dict[str, Learned], dict[str, str], Weights | None]:
    """Return what each run has learned, its verdict, and the weights of several."""
    from calibrate.prediction.several import weights_of
    from calibrate.prediction.transfer import Learned
    from calibrate.project import holds_population, read_posterior
    from calibrate.project.calibration import NOT_CERTIFIED
    from calibrate.project.results import CERTIFICATE

    bodies, verdicts, trees = {}, {}, {}
    for run in runs:
        if holds_population(run):
            if len(runs) > 1:
                raise InputError(f"{run} is a population; several laws are of one body each")
            bodies[run], verdicts[run] = Learned.of_population(run), _OF_MEMBERS
            continue
        posterior = read_posterior(run)[1]
        bodies[run], trees[run] = Learned.of(posterior), posterior.tree
        file = Path(run) / CERTIFICATE
        verdicts[run] = read_json(file)["verdict"] if file.is_file() else NOT_CERTIFIED
    return bodies, verdicts, weights_of(trees) if len(runs) > 1 else None


def bands_summary(result: dict[str, Any]) -> str:
    """Return :func:`calibrate.prediction.output.as_json` as text."""
    from calibrate.prediction.beyond import Beyond, Reach

    columns = {"unit": "unit", "mean": "mean", "sd": "sd", "low": "5 %", "median": "50 %"}
    columns["high"], beyond = "95 %", str(Beyond([], result["distances"]))
    if beyond:
        columns |= {"outer_low": "outer 5 %", "outer_high": "95 %"}
    shown = list(result["numbers"].items())
    rows = [[name, *(row[key] for key in columns)] for name, row in shown[:_ROWS]]
    lines = [table(("prediction", *columns.values()), rows)]
    if len(shown) > _ROWS:
        lines.append(f"and {len(shown) - _ROWS} more numbers")
    by_source: dict[str, list[str]] = {}
    for name, source in result["sources"].items():
        by_source.setdefault(source, []).append(name)
    lines += [f"{', '.join(names)}: {source}" for source, names in by_source.items()]
    lines += _laws_summary(result)
    others = (
        f"{result['fem_runs']} of them by FEM; others are those of a process, which missed tests "
        f"by {result['missed_sd']:.2g} sd of the draws"
    )
    every = result["fem_runs"] >= result["draws"]
    lines.append(f"{result['draws']} draws, {'each of them solved' if every else others}")
    lines += [str(Reach(**one)) for one in result["beyond"] if one["share"] > 0.0]
    return "\n".join([*lines, *filter(None, [beyond]), *result["warnings"]])


def _laws_summary(result: dict[str, Any]) -> list[str]:
    """Return the verdict on a posterior, or a table of several laws and what each predicts."""
    if "laws" not in result:
        return [f"verdict on the posterior: {result['posterior']}"]
    rows = [
        [row["law"], row["posterior"], row["stacking"], row["evidence"],
         result["posterior"][row["posterior"]]]
        for row in result["laws"]
    ]  # fmt: skip
    lines = [table(("law", "posterior", "stacking", "evidence", "verdict"), rows)]
    for name in list(result["numbers"])[:_ROWS]:
        bands = (
            f"{row['law']} {numbers[name]['low']:.4g} to {numbers[name]['high']:.4g}"
            for row in result["laws"]
            for numbers in [result["by_law"][row["posterior"]]]
        )
        lines.append(f"{name}: {', '.join(bands)}")
    return lines


def _at_one_theta(arguments: Namespace) -> Answer:
    """Predict at one theta, with the guard's verdict."""
    import jax
    import numpy as np

    from emulator.accuracy.estimate import guard
    from emulator.fem.outcome import by_name, cavity_volumes, write_outcome
    from emulator.surrogates import load

    if arguments.out:
        words.check_vtu(arguments.out)
    (name,) = arguments.emulator
    emulator = load(name)
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
        "emulator": name,
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
