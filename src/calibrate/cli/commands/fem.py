"""``calibrate simulate``, ``unload`` and ``campaign``: finite elements."""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.output import DONE, FAILED, emit, show_progress, volume_lines, volumes
from calibrate.cli.words import (
    add_load_steps,
    add_scene,
    add_scheduler,
    add_seed,
    add_theta,
    answer,
    check_vtu,
    scene_of,
    theta_by_name,
    theta_of,
)
from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    from emulator.fem.unloading import Unloaded
    from emulator.scenes.scene import Scene


def add_simulate(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser("simulate", help="solve a scene by finite elements")
    add_scene(parser)
    add_theta(parser)
    add_load_steps(parser)
    parser.add_argument(
        "--out", metavar="FILE.vtu", help="write displacement, stress, strain and fibres"
    )
    answer(parser, run_simulate)


def run_simulate(arguments: argparse.Namespace) -> int:
    """Solve at one theta and print status and key figures."""
    import jax
    import numpy as np

    from emulator.fem import NewtonOptions, Simulator, Status
    from emulator.fem.energy import potential_energy, volume_ratio
    from emulator.fem.fields import element_fields
    from emulator.fem.reactions import supported_sets
    from emulator.geometry.io import write_solution

    scene = scene_of(arguments)
    theta = theta_of(arguments, scene)
    if arguments.out:
        check_vtu(arguments.out)
    simulator = Simulator(scene, NewtonOptions.load_steps(arguments.load_steps))
    solution = simulator.solve(theta)
    status = Status(int(solution.status))
    J = np.asarray(jax.jit(partial(volume_ratio, scene))(solution.displacement))
    # A follower pressure on an open patch has no potential energy. Where the mesh is the loaded
    # shape, energy, stresses and reactions belong to the scene at rest (calibrate unload).
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
        "theta": theta_by_name(scene, theta),
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
    energy_text = "no potential energy" if energy is None else f"energy {energy:.8g} mN mm"
    lines.append(f"largest displacement {result['max_displacement']:.6g} mm, {energy_text}")
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
    emit(arguments, result, "\n".join(lines))
    return DONE if status is Status.CONVERGED else FAILED


MESH, LOADED = "unloaded.vtu", "loaded.vtu"
_TOLERANCE = 1e-6  # largest distance of mesh and reloaded shape, in sizes of the body


def add_unload(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "unload",
        help="the stress-free shape of a mesh that is known under load",
        description="Takes the scene's mesh for the shape under the loads of theta, as a mesh made "
        "from an image is, finds the shape without them, and loads that again from rest.",
        epilog="example: calibrate unload ventricle.toml --theta a=0.3 pressure=1.2 --out unloaded",
    )
    add_scene(parser)
    add_theta(parser)
    parser.add_argument(
        "--out",
        metavar="DIR",
        help=f"write {MESH} (the mesh with its sets and fibres, for a scene file) and {LOADED} "
        "(with displacement, stress and strain under the loads)",
    )
    answer(parser, run_unload)


def run_unload(arguments: argparse.Namespace) -> int:
    """Find the stress-free shape, load it again, and write both."""
    from emulator.fem import Status
    from emulator.fem.unloading import Unloader

    scene = scene_of(arguments)
    theta = theta_of(arguments, scene)
    if arguments.out:
        check_folder(arguments.out)
    unloaded = Unloader(scene).solve(theta)
    status = Status(int(unloaded.status))
    result: dict[str, Any] = {
        "scene": scene.name,
        "theta": theta_by_name(scene, theta),
        "status": status.name.lower(),
        "iterations": int(unloaded.iterations),
        "residual": float(unloaded.residual),
        "load_reached": float(unloaded.load_reached),
    }
    lines = [f"{scene.name}: {status.text}, {result['iterations']} Newton iterations"]
    valid = status is Status.CONVERGED and _reload(scene, unloaded, theta, result, lines)
    if valid and arguments.out:
        _write_unloaded(Path(arguments.out), unloaded, theta)
        result["out"] = arguments.out
        lines.append(f"written to {arguments.out}: {MESH}, {LOADED}")
    emit(arguments, result, "\n".join(lines))
    return DONE if valid else FAILED


def _reload(
    scene: Scene, unloaded: Unloaded, theta: Any, result: dict[str, Any], lines: list[str]
) -> bool:
    """Return whether the shape, loaded from rest, is the mesh; extend ``result`` and ``lines``."""
    import numpy as np

    from emulator.fem import Simulator, Status

    w = np.asarray(unloaded.displacement)
    simulator = Simulator(unloaded.scene)
    reloaded = simulator.solve(theta)
    status = Status(int(reloaded.status))
    missed = float(np.abs(reloaded.displacement - unloaded.start).max())
    cavities = {
        name: {"loaded_ml": each["rest_ml"], "unloaded_ml": each["volume_ml"]}
        for name, each in volumes(scene, unloaded.displacement).items()
    }
    result |= {
        "largest_displacement": float(np.linalg.norm(w, axis=1).max()),
        "volumes": cavities,
        "reloaded": {
            "status": status.name.lower(),
            "residual": float(reloaded.residual),
            "missed": missed,
        },
    }
    lines.append(f"largest displacement {result['largest_displacement']:.6g} mm")
    lines += [
        f"cavity '{name}': {each['unloaded_ml']:.6g} mL, under load {each['loaded_ml']:.6g} mL"
        for name, each in cavities.items()
    ]
    lines.append(
        f"loaded again from rest: {status.text}, residual {reloaded.residual:.1e}, "
        f"{missed:.1e} mm from the mesh"
    )
    agrees = status is Status.CONVERGED and missed <= _TOLERANCE * scene.mesh.size
    if not agrees:
        lines.append(
            "loading leads elsewhere: tissue this soft would not stay in the mesh's shape; look at "
            "theta"
        )
    return agrees


def _write_unloaded(folder: Path, unloaded: Unloaded, theta: Any) -> None:
    """Write the mesh for a scene file, and the body under its loads for a picture."""
    import numpy as np

    from emulator.fem.fields import element_fields
    from emulator.geometry.io import write_mesh, write_solution

    scene = unloaded.scene
    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(folder / MESH, scene.mesh, scene.fibres, scene.sheets)
    fields = element_fields(scene, unloaded.start, theta)
    write_solution(folder / LOADED, scene.mesh, np.asarray(unloaded.start), fields)


def add_campaign(commands: Any) -> None:
    """Add the command."""
    from emulator.fem.campaign.designs import DESIGNS

    parser = commands.add_parser(
        "campaign",
        help="FEM at many theta, into one Zarr store",
        description="Solves a scene at every theta of a design and writes one Zarr store, which "
        "xarray.open_zarr reads: displacement over theta_id, node and xyz, with status and hash of "
        "each row. The same command, given again, solves what is missing.",
        epilog="examples: calibrate campaign left_ventricle --samples 200 --out runs.zarr; "
        "calibrate campaign scene.toml --samples 2000 --slopes --scheduler tcp://127.0.0.1:8786 "
        "--out runs.zarr; calibrate train left_ventricle --campaign runs.zarr --out emulator",
    )
    add_scene(parser)
    parser.add_argument("--samples", type=int, required=True, metavar="N", help="theta to solve at")
    parser.add_argument(
        "--design",
        choices=tuple(DESIGNS),
        default="sobol",
        help="where the theta are (default sobol); sobol_corners has the box's corners too, as "
        "emulators are trained on",
    )
    add_seed(parser, "the design")
    parser.add_argument("--slopes", action="store_true", help="du/dtheta, too")
    add_load_steps(parser)
    add_scheduler(parser, "solve")
    parser.add_argument("--out", required=True, metavar="STORE.zarr")
    answer(parser, run_campaign)


def run_campaign(arguments: argparse.Namespace) -> int:
    """Solve what the store lacks, and count rows by their status."""
    from calibrate.project.campaigns import fill, question
    from emulator.fem import NewtonOptions
    from emulator.fem.campaign.store import count_statuses

    start = time.perf_counter()
    if not arguments.out.endswith(".zarr"):
        raise InputError(f"--out {arguments.out}: the store's name must end in .zarr")
    campaign = question(
        scene_of(arguments),
        arguments.samples,
        design=arguments.design,
        seed=arguments.seed,
        slopes=arguments.slopes,
        options=NewtonOptions.load_steps(arguments.load_steps),
    )
    progress = show_progress(arguments)
    solved = fill(campaign, arguments.out, scheduler=arguments.scheduler, progress=progress)
    counts = count_statuses(arguments.out)
    samples = sum(counts.values())
    seconds = time.perf_counter() - start
    result = {
        "out": arguments.out,
        "scene": campaign.scene.name,
        "samples": samples,
        "solved_now": solved,
        "status": counts,
        "seconds": seconds,
    }
    statuses = ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in counts.items())
    text = (
        f"{campaign.scene.name}, {samples} theta: {statuses}\n"
        f"{solved} solved now in {seconds:.0f} s, written to {arguments.out}"
    )
    emit(arguments, result, text)
    return DONE if counts.get("converged") else FAILED
