"""``calibrate scenes`` and ``calibrate simulate``."""

from __future__ import annotations

import argparse
from typing import Any

from calibrate.cli.common import (
    DONE,
    FAILED,
    add_json,
    add_scene,
    assignments,
    check_vtu,
    emit,
    table,
)


def register(commands: Any) -> None:
    """Add the commands."""
    parser = commands.add_parser("scenes", help="what is built in")
    add_json(parser)
    parser.set_defaults(run=scenes)
    parser = commands.add_parser("simulate", help="solve a scene by finite elements")
    add_scene(parser)
    parser.add_argument(
        "--theta", nargs="+", default=[], metavar="NAME=VALUE", help="default: the box's centre"
    )
    parser.add_argument(
        "--load-steps",
        type=int,
        default=1,
        metavar="N",
        help="follow the loading path; a very soft body has several equilibria (default 1)",
    )
    parser.add_argument(
        "--out", metavar="FILE.vtu", help="write displacement, stress, strain and fibres"
    )
    add_json(parser)
    parser.set_defaults(run=simulate)


def scenes(arguments: argparse.Namespace) -> int:
    """List the built-in scenes and the emulators shipped for them."""
    from emulator.network import shipped
    from emulator.scenes import BUILT_IN

    available = shipped()
    rows: list[dict[str, Any]] = []
    for name, make in sorted(BUILT_IN.items()):
        scene = make()
        rows.append(
            {
                "name": name,
                "nodes": len(scene.mesh.nodes),
                "elements": len(scene.mesh.elements),
                "law": scene.law.name,
                "parameters": [
                    {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "scale": p.scale}
                    for p in scene.parameters
                ],
                "emulator_shipped": name in available,
            }
        )
    text = table(
        ("scene", "nodes", "tetrahedra", "law", "parameters", "emulator"),
        [
            (
                r["name"],
                r["nodes"],
                r["elements"],
                r["law"],
                ", ".join(
                    f"{p['name']} {p['low']:g}-{p['high']:g} {p['unit']}".strip()
                    for p in r["parameters"]
                ),
                "shipped" if r["emulator_shipped"] else "train it",
            )
            for r in rows
        ],
    )
    emit(rows, as_json=arguments.json, text=text)
    return DONE


def simulate(arguments: argparse.Namespace) -> int:
    """Solve at one theta and say how it went."""
    import numpy as np

    from emulator.fem import NewtonOptions, Simulator, Status
    from emulator.geometry.io import write_solution
    from emulator.mechanics.energy import potential_energy, volume_ratio
    from emulator.mechanics.fields import element_fields
    from emulator.mechanics.follower import FollowerPressure
    from emulator.scenes import find_scene

    scene = find_scene(arguments.scene, arguments.root)
    theta = scene.theta(**assignments(arguments.theta)) if arguments.theta else scene.centre
    if arguments.out:
        check_vtu(arguments.out)
    simulator = Simulator(scene, NewtonOptions.load_steps(arguments.load_steps))
    solution = simulator.solve(theta)
    status = Status(int(solution.status))
    J = np.asarray(volume_ratio(scene, solution.displacement))
    # A pressure that follows an open patch has no potential.
    open_patch = any(isinstance(load, FollowerPressure) for load in scene.loads)
    energy = None if open_patch else float(potential_energy(scene)(solution.displacement, theta))
    stable = None
    if status is Status.CONVERGED and not open_patch:
        stable = simulator.is_stable(solution.displacement, theta)
    result = {
        "scene": scene.name,
        "theta": dict(zip(scene.parameter_names, map(float, theta), strict=True)),
        "status": status.name.lower(),
        "iterations": int(solution.iterations),
        "residual": float(solution.residual),
        "load_reached": float(solution.load_reached),
        "energy": energy,
        "stable": stable,
        "max_displacement": float(np.linalg.norm(solution.displacement, axis=1).max()),
        "J_range": [float(J.min()), float(J.max())],
    }
    if arguments.out and status is Status.CONVERGED:
        u = np.asarray(solution.displacement)
        fields = element_fields(scene, solution.displacement, theta)
        write_solution(arguments.out, scene.mesh, u, fields)
        result["out"] = arguments.out
    lines = [f"{scene.name}: {status.text}, {result['iterations']} Newton iterations"]
    told = "no potential energy" if energy is None else f"energy {energy:.8g} mN mm"
    lines.append(f"largest displacement {result['max_displacement']:.6g} mm, {told}")
    lines.append(
        f"J from {J.min():.4f} to {J.max():.4f}, relative residual {result['residual']:.1e}"
    )
    if stable is False:
        lines.append(
            "an unstable equilibrium: it has buckled, and any imperfection leads elsewhere"
        )
    emit(result, as_json=arguments.json, text="\n".join(lines))
    return DONE if status is Status.CONVERGED else FAILED
