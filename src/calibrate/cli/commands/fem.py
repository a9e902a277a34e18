"""``calibrate simulate``, ``unload`` and ``campaign``: finite elements."""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli import words
from calibrate.cli.output import volume_lines, volumes
from calibrate.cli.words import Answer, command, flag, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    from emulator.fem import Solution
    from emulator.fem.unloading import Unloaded
    from emulator.scenes.scene import Scene


def _solved(scene: Scene, theta: Any, solution: Solution | Unloaded) -> tuple[dict[str, Any], str]:
    """Return the outcome of a solve, as plain JSON and in a line."""
    from emulator.fem import Status

    status = Status(int(solution.status))
    result = {
        "scene": scene.name,
        "theta": words.theta_by_name(scene, theta),
        "status": status.name.lower(),
        "iterations": int(solution.iterations),
        "residual": float(solution.residual),
        "load_reached": float(solution.load_reached),
    }
    return result, f"{scene.name}: {status.text}, {result['iterations']} Newton iterations"


@command(
    words.add_scene,
    words.THETA,
    words.load_steps_option(),
    option("--out", "FILE.vtu", "write displacement, stress, strain and fibres"),
    help="solve a scene by finite elements",
)
def simulate(arguments: Namespace) -> Answer:
    """Solve at one theta, and find status and key figures."""
    import jax
    import numpy as np

    from emulator.fem import NewtonOptions, Simulator
    from emulator.fem.energy import potential_energy, volume_ratio
    from emulator.fem.fields import element_fields
    from emulator.fem.reactions import supported_sets
    from emulator.geometry.io import write_solution

    scene = words.scene_of(arguments)
    theta = words.theta_of(arguments, scene)
    if arguments.out:
        words.check_vtu(arguments.out)
    simulator = Simulator(scene, NewtonOptions.load_steps(arguments.load_steps))
    solution = simulator.solve(theta)
    u, converged = solution.displacement, bool(solution.converged)
    J = np.asarray(jax.jit(partial(volume_ratio, scene))(u))
    # A follower pressure on an open patch has no potential energy. Where the mesh is the loaded
    # shape, energy, stresses and reactions belong to the scene at rest (calibrate unload).
    at_rest = not scene.loaded_by
    has_potential = at_rest and all(load.has_potential for load in scene.loads)
    energy = float(jax.jit(potential_energy(scene))(u, theta)) if has_potential else None
    stable = simulator.is_stable(u, theta) if has_potential and converged else None
    result, line = _solved(scene, theta, solution)
    result |= {
        "energy": energy,
        "stable": stable,
        "max_displacement": float(np.linalg.norm(u, axis=1).max()),
        "J_range": [float(J.min()), float(J.max())],
        "volumes": volumes(scene, u),
    }
    energy_text = "no potential energy" if energy is None else f"energy {energy:.8g} mN mm"
    lines = [
        line,
        f"largest displacement {result['max_displacement']:.6g} mm, {energy_text}",
        f"J from {J.min():.4f} to {J.max():.4f}, relative residual {result['residual']:.1e}",
        *volume_lines(result["volumes"]),
    ]
    if converged:
        result["reactions"] = {
            name: simulator.reaction(name, u, theta).tolist()
            for name in (supported_sets(scene) if at_rest else ())
        }
        for name, force in result["reactions"].items():
            components = ", ".join(f"{component:.5g}" for component in force)
            lines.append(f"force of the support '{name}' on the body: {components} mN")
    if arguments.out and converged:
        fields = element_fields(scene, u, theta) if at_rest else {}
        write_solution(arguments.out, scene.mesh, np.asarray(u), fields)
        result["out"] = arguments.out
    if stable is False:
        lines.append(
            "an unstable equilibrium: it has buckled, and any imperfection leads elsewhere"
        )
    return Answer(result, "\n".join(lines), converged)


MESH, LOADED = "unloaded.vtu", "loaded.vtu"
_TOLERANCE = 1e-6  # largest distance of mesh and reloaded shape, in sizes of the body


@command(
    words.add_scene,
    words.THETA,
    option(
        "--out",
        "DIR",
        f"write {MESH} (the mesh with its sets and fibres, for a scene file) and {LOADED} "
        "(with displacement, stress and strain under the loads)",
    ),
    help="the stress-free shape of a mesh that is known under load",
    description="Takes the scene's mesh for the shape under the loads of theta, as a mesh made "
    "from an image is, finds the shape without them, and loads that again from rest. Where "
    "there is none, it says how much of the load could be taken off.",
    epilog="example: calibrate unload ventricle.toml --theta a=0.3 pressure=1.2 --out unloaded",
)
def unload(arguments: Namespace) -> Answer:
    """Find the stress-free shape, load it again, and write both."""
    import numpy as np

    from emulator.fem import Simulator, Status
    from emulator.fem.fields import element_fields
    from emulator.fem.unloading import Unloader
    from emulator.geometry.io import write_mesh, write_solution

    scene = words.scene_of(arguments)
    theta = words.theta_of(arguments, scene)
    if arguments.out:
        check_folder(arguments.out)
    unloaded = Unloader(scene).solve(theta)
    result, line = _solved(scene, theta, unloaded)
    if not unloaded.converged:
        result["taken_off"] = {name: amount for name, (amount, _) in unloaded.taken_off.items()}
        return Answer(result, f"{line}\n{unloaded.limit}", usable=False)
    rest, start = unloaded.scene, np.asarray(unloaded.start)
    reloaded = Simulator(rest).solve(theta)
    status = Status(int(reloaded.status))
    missed = float(np.abs(reloaded.displacement - start).max())
    result |= {
        "largest_displacement": float(np.linalg.norm(unloaded.displacement, axis=1).max()),
        "volumes": {
            name: {"loaded_ml": volume["rest_ml"], "unloaded_ml": volume["volume_ml"]}
            for name, volume in volumes(scene, unloaded.displacement).items()
        },
        "reloaded": {
            "status": status.name.lower(),
            "residual": float(reloaded.residual),
            "missed": missed,
        },
    }
    lines = [line, f"largest displacement {result['largest_displacement']:.6g} mm"]
    lines += [
        f"cavity '{name}': {volume['unloaded_ml']:.6g} mL, under load {volume['loaded_ml']:.6g} mL"
        for name, volume in result["volumes"].items()
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
    elif arguments.out:
        folder = Path(arguments.out)
        folder.mkdir(parents=True, exist_ok=True)
        write_mesh(folder / MESH, rest.mesh, rest.fibres, rest.sheets)
        fields = element_fields(rest, unloaded.start, theta)
        write_solution(folder / LOADED, rest.mesh, start, fields)
        result["out"] = arguments.out
        lines.append(f"written to {arguments.out}: {MESH}, {LOADED}")
    return Answer(result, "\n".join(lines), agrees)


def _add_design(parser: ArgumentParser) -> None:
    from emulator.fem.campaign.designs import DESIGNS

    parser.add_argument(
        "--design",
        choices=tuple(DESIGNS),
        default="sobol",
        help="where the theta are (default sobol); sobol_corners has the box's corners too, as "
        "emulators are trained on",
    )


@command(
    words.add_scene,
    option("--samples", "N", "theta to solve at", type=int, required=True),
    _add_design,
    words.seed_option("the design"),
    flag("--slopes", "du/dtheta, too"),
    words.load_steps_option(),
    option("--out", "STORE.zarr", required=True),
    help="FEM at many theta, into one Zarr store",
    description="Solves a scene at every theta of a design and writes one Zarr store, which "
    "xarray.open_zarr reads: displacement over theta_id, node and xyz, with status and hash of "
    "each row. The same command, given again, solves what is missing.",
    epilog="examples: calibrate campaign left_ventricle --samples 200 --out runs.zarr; "
    "calibrate train left_ventricle --campaign runs.zarr --out emulator",
)
def campaign(arguments: Namespace) -> Answer:
    """Solve the rows that the store lacks, and count rows by their status."""
    from calibrate.project.campaigns import fill, question
    from emulator.fem import NewtonOptions
    from emulator.fem.campaign.store import count_statuses

    start, out = time.perf_counter(), arguments.out
    if not out.endswith(".zarr"):
        raise InputError(f"--out {out}: the store's name must end in .zarr")
    scene, options = words.scene_of(arguments), NewtonOptions.load_steps(arguments.load_steps)
    plan = words.parameters(question, arguments) | {"scene": scene, "options": options}
    solved = fill(question(**plan), out, progress=not arguments.json)
    counts = count_statuses(out)
    samples, seconds = sum(counts.values()), time.perf_counter() - start
    result = {
        "out": out,
        "scene": scene.name,
        "samples": samples,
        "solved_now": solved,
        "status": counts,
        "seconds": seconds,
    }
    statuses = ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in counts.items())
    text = (
        f"{scene.name}, {samples} theta: {statuses}\n"
        f"{solved} solved now in {seconds:.0f} s, written to {out}"
    )
    return Answer(result, text, bool(counts.get("converged")))
