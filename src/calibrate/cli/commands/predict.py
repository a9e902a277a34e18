"""``calibrate predict``."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import DONE, FAILED, add_theta, assignments, check_vtu, emit
from calibrate.cli.volumes import volume_lines, volumes
from emulator.core.errors import InputError

if TYPE_CHECKING:
    import jax

    from emulator.accuracy.estimate import ErrorEstimate
    from emulator.scenes import Scene


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "predict",
        help="an emulator's displacement, and whether to trust it",
        description="Evaluate an emulator at one theta. Exit code 1 says not to trust the result: "
        "theta outside the box, an inverted element, no equilibrium near the prediction.",
    )
    parser.add_argument("emulator", metavar="EMULATOR", help="shipped name or folder")
    add_theta(parser)
    parser.add_argument(
        "--error-bar", action="store_true", help="estimate the error from the residual forces"
    )
    parser.add_argument("--out", metavar="FILE.vtu", help="write displacement, stress and strain")


def run(arguments: argparse.Namespace) -> int:
    """Predict at one theta and report the guard's verdict."""
    from functools import partial

    import jax
    import numpy as np

    from emulator.accuracy.guard import guard
    from emulator.fem.fields import element_fields
    from emulator.geometry.io import write_solution
    from emulator.surrogates import load

    if arguments.out:
        check_vtu(arguments.out)
    emulator = load(arguments.emulator)
    scene, forward = emulator.scene, emulator.cache()
    values = assignments(arguments.theta)
    theta = anywhere(scene, values) if values else scene.centre
    u = forward(theta)
    estimate, against = None, jax.jit(partial(guard, scene))(theta, u)
    if arguments.error_bar:
        from emulator import Simulator
        from emulator.accuracy.estimate import error_bar

        estimate = error_bar(forward, Simulator(scene)).of_field(u, theta)
        against = estimate.guard
    finite = bool(against.finite)
    result: dict[str, Any] = {
        "emulator": arguments.emulator,
        "scene": scene.name,
        "theta": dict(zip(scene.parameter_names, map(float, theta), strict=True)),
        "trusted": bool(against.trusted),
        "guard": against.sentence(scene),
        "max_displacement": float(np.linalg.norm(u, axis=1).max()) if finite else None,
        "least_J": float(against.least_J) if finite else None,
        "volumes": volumes(scene, u, estimate) if finite else {},
        "error": None if estimate is None else error_of(estimate),
    }
    if arguments.out and finite and against.least_J > 0.0:
        write_solution(arguments.out, scene.mesh, np.asarray(u), element_fields(scene, u, theta))
        result["out"] = arguments.out
    emit(result, as_json=arguments.json, text=summary(result))
    return DONE if result["trusted"] else FAILED


def anywhere(scene: Scene, values: dict[str, float]) -> jax.Array:
    """Theta (p,) from named finite values, which may lie outside the box."""
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


def error_of(estimate: ErrorEstimate) -> dict[str, Any]:
    """The error bar as plain JSON; without numbers where it is not valid."""
    if not estimate.valid:
        return {"valid": False}
    gap, least = float(estimate.energy_gap), float(estimate.least_energy)
    return {
        "valid": True,
        "median_mm": float(estimate.median),
        "mean_mm": float(estimate.mean),
        "max_mm": float(estimate.max),
        "energy_gap": gap,
        "energy_gap_percent": 100.0 * gap / abs(least) if least else None,
        "contraction": float(estimate.contraction),
        "iterations": int(estimate.iterations),
    }


def summary(result: dict[str, Any]) -> str:
    """The result as text."""
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
            f"largest {error['max_mm']:.2g} mm{gap}"
        )
    if not result["trusted"]:
        lines.append(f"not to be trusted: {result['guard']}")
    return "\n".join(lines)
