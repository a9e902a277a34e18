"""``calibrate simulate``."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

from calibrate.cli.common import (
    DONE,
    FAILED,
    add_scene,
    add_theta,
    assignments,
    check_vtu,
    emit,
    scene_words,
)
from calibrate.cli.volumes import volume_lines, volumes


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("simulate", help="solve a scene by finite elements")
    add_scene(parser)
    add_theta(parser)
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


def run(arguments: argparse.Namespace) -> int:
    """Solve at one theta and print status and key figures."""
    import jax
    import numpy as np

    from emulator.catalogue import find_scene
    from emulator.fem import NewtonOptions, Simulator, Status
    from emulator.fem.energy import potential_energy, volume_ratio
    from emulator.fem.fields import element_fields
    from emulator.fem.reactions import supported_sets
    from emulator.geometry.io import write_solution

    scene = find_scene(*scene_words(arguments))
    theta = scene.theta(**assignments(arguments.theta)) if arguments.theta else scene.centre
    if arguments.out:
        check_vtu(arguments.out)
    simulator = Simulator(scene, NewtonOptions.load_steps(arguments.load_steps))
    solution = simulator.solve(theta)
    status = Status(int(solution.status))
    J = np.asarray(jax.jit(partial(volume_ratio, scene))(solution.displacement))
    # A follower pressure on an open patch has no potential energy; that of a body whose mesh is
    # loaded, its stresses and reactions belong to the scene at rest (calibrate unload).
    at_rest = not scene.loaded_by
    open_patch = not (at_rest and all(load.has_potential for load in scene.loads))
    energy = None
    if not open_patch:
        energy = float(jax.jit(potential_energy(scene))(solution.displacement, theta))
    stable = None
    if status is Status.CONVERGED and not open_patch:
        stable = simulator.is_stable(solution.displacement, theta)
    result: dict[str, Any] = {
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
        "volumes": volumes(scene, solution.displacement),
    }
    reactions: dict[str, list[float]] = {}
    if status is Status.CONVERGED:
        for name in supported_sets(scene) if at_rest else ():
            reactions[name] = simulator.reaction(name, solution.displacement, theta).tolist()
        result["reactions"] = reactions
    if arguments.out and status is Status.CONVERGED:
        u = np.asarray(solution.displacement)
        fields = element_fields(scene, solution.displacement, theta) if at_rest else {}
        write_solution(arguments.out, scene.mesh, u, fields)
        result["out"] = arguments.out
    lines = [f"{scene.name}: {status.text}, {result['iterations']} Newton iterations"]
    told = "no potential energy" if energy is None else f"energy {energy:.8g} mN mm"
    lines.append(f"largest displacement {result['max_displacement']:.6g} mm, {told}")
    lines.append(
        f"J from {J.min():.4f} to {J.max():.4f}, relative residual {result['residual']:.1e}"
    )
    lines += volume_lines(result["volumes"])
    for name, force in reactions.items():
        components = ", ".join(f"{component:.5g}" for component in force)
        lines.append(f"force of the support '{name}' on the body: {components} mN")
    if stable is False:
        lines.append(
            "an unstable equilibrium: it has buckled, and any imperfection leads elsewhere"
        )
    emit(result, as_json=arguments.json, text="\n".join(lines))
    return DONE if status is Status.CONVERGED else FAILED
