"""``calibrate predict`` and ``evaluate``: an emulator at one theta, and its errors at many."""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli import words
from calibrate.cli.output import table, volume_lines
from calibrate.cli.words import Answer, command, flag, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder, write_json

if TYPE_CHECKING:
    import jax

    from emulator.accuracy.estimate import ErrorEstimate
    from emulator.scenes import Scene

_EMULATOR = option("emulator", "EMULATOR", "shipped name or folder")


@command(
    _EMULATOR,
    words.THETA,
    flag("--error-bar", "estimate the error from the residual forces"),
    option("--out", "FILE.vtu", "write displacement, stress and strain"),
    help="an emulator's displacement, and whether to trust it",
    description="Evaluate an emulator at one theta. Exit code 1 says not to trust the result: "
    "theta outside the box, an inverted element, no equilibrium near the prediction.",
)
def predict(arguments: Namespace) -> Answer:
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


@command(
    _EMULATOR,
    option("--against", "DIR|fem", "a published model's folder, or our FEM", required=True),
    option("--cases", type=int, help="FEM runs when against fem (default 50)"),
    words.add_forward,
    option("--out", "DIR", "write evaluation.json and figures"),
    help="errors of an emulator against FEM",
)
def evaluate(arguments: Namespace) -> Answer:
    """Compare a forward map with stored or fresh FEM solutions."""
    from calibrate.analysis.evaluation import run_evaluation

    options = words.forward_options(arguments)
    if arguments.out:
        from calibrate.figures import pyplot

        check_folder(arguments.out)
        pyplot()  # a missing plotting package is reported before minutes of FEM
    evaluated = run_evaluation(
        **words.parameters(run_evaluation, arguments),
        forward_options=options,
        progress=not arguments.json,
    )
    report = dict(evaluated.report)
    text = evaluation_summary(report)
    if arguments.out:
        from calibrate.figures.evaluation import draw

        path = Path(arguments.out) / "evaluation.json"
        write_json(path, evaluated.report)
        report["files"] = [str(file) for file in (path, *draw(evaluated, arguments.out))]
        text += f"\nwritten: {', '.join(report['files'])}"
    return Answer(report, text)


def evaluation_summary(report: Mapping[str, Any]) -> str:
    """Return the table of errors as text."""
    rows = [
        (name, *(report[name][q] for q in ("median", "mean", "q97_5", "max")), unit)
        for name, unit in report["units"].items()
        if name in report
    ]
    title = f"{report['cases']} cases"
    lines = [table((title, "median", "mean", "97.5 %", "max", "unit"), rows)]
    lines.append(f"forward map: {report['label']}, reference: {report['reference']}")
    if report["invalid"]:
        lines.append(f"{report['invalid']} further cases without a valid prediction")
    return "\n".join(lines)
