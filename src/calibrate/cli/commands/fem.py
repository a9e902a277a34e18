"""``calibrate simulate``, ``unload`` and ``campaign``: finite elements."""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli import words
from calibrate.cli.output import volume_lines
from calibrate.cli.words import Answer, command, flag, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    import jax

    from emulator.scenes.forward_problem import ForwardProblem


@command(
    words.add_scene,
    words.THETA,
    words.load_steps_option(),
    option("--out", "FILE.vtu", "write displacement, stress, strain and fibres"),
    help="solve a scene by finite elements",
)
def simulate(arguments: Namespace) -> Answer:
    """Solve at one theta, and find status and key figures."""
    from emulator.fem import NewtonOptions, Simulator
    from emulator.fem.outcome import described, equilibrium, write_outcome
    from emulator.scenes.scene import Scene, with_mesh

    problem = words.problem_of(arguments)
    if problem.outside:
        return _run_outside(problem, words.theta_of(arguments, problem))
    if problem.components:
        return _run_history(problem, words.theta_of(arguments, problem), arguments.out)
    if not isinstance(problem, Scene) and not arguments.out:
        return _simulate_states(problem, words.theta_of(arguments, problem))
    scene = with_mesh(problem)
    theta = words.theta_of(arguments, scene)
    if arguments.out:
        words.check_vtu(arguments.out)
    simulator = Simulator(scene, NewtonOptions.load_steps(arguments.load_steps))
    solution = simulator.solve(theta)
    result = described(scene, theta, solution) | equilibrium(simulator, theta, solution)
    energy, (least, most) = result["energy"], result["J_range"]
    energy_text = "no potential energy" if energy is None else f"energy {energy:.8g} mN mm"
    lines = [
        _in_a_line(result),
        f"largest displacement {result['max_displacement']:.6g} mm, {energy_text}",
        f"J from {least:.4f} to {most:.4f}, relative residual {result['residual']:.1e}",
        *volume_lines(result["volumes"]),
    ]
    for name, force in result.get("reactions", {}).items():
        components = ", ".join(f"{component:.5g}" for component in force)
        lines.append(f"force of the support '{name}' on the body: {components} mN")
    if arguments.out and solution.converged:
        write_outcome(arguments.out, scene, solution.displacement, theta)
        result["out"] = arguments.out
    if result["stable"] is False:
        lines.append(
            "an unstable equilibrium: it has buckled, and any imperfection leads elsewhere"
        )
    return Answer(result, "\n".join(lines), bool(solution.converged))


def _in_a_line(result: dict[str, Any]) -> str:
    from emulator.fem import Status

    status = Status[result["status"].upper()]
    return f"{result['scene']}: {status.text}, {result['iterations']} Newton iterations"


def _run_outside(problem: ForwardProblem, theta: jax.Array) -> Answer:
    """Run another program at one theta, and return its outputs."""
    import numpy as np

    from calibrate.measurements.words import kinds_of
    from calibrate.project.problem import simulator_of

    u = simulator_of(problem)(theta)
    parts = {name: kind.of(problem) for name, kind in kinds_of(problem).items()}
    outputs = {n: np.asarray(part(u[part.nodes], theta)).tolist() for n, part in parts.items()}
    units = {name: "" if part.unit == "1" else f" {part.unit}" for name, part in parts.items()}
    lines = [f"{name}: {value}{units[name]}" for name, value in outputs.items()]
    return Answer({"scene": problem.name, "outputs": outputs}, "\n".join(lines))


def _run_history(problem: Any, theta: jax.Array, out: str | None) -> Answer:
    """Go through a history at one theta; find the motion at each row, and the error of the steps.

    out : the file of the series of shapes, or None.
    """
    import numpy as np

    from calibrate.cli.output import table
    from calibrate.project.problem import simulator_of
    from emulator.fem.history import half_steps_error, write_history

    if out:
        words.check_vtu(out)
    u = simulator_of(problem)(theta)
    largest = np.linalg.norm(problem.rows_of(u), axis=-1).max(axis=-1)
    error = half_steps_error(problem, u, theta)
    columns = {name: values.tolist() for name, values in problem.known.items()}
    columns["largest displacement (mm)"] = largest.tolist()
    if len(problem.tests) > 1:
        names = {int(row): name for name, rows in problem.tests.items() for row in rows}
        columns = {"test": [names[row] for row in range(len(names))]} | columns
    lines = [table(list(columns), list(zip(*columns.values(), strict=True)))]
    lines.append(
        f"steps half as long move a node by {error:.2g} mm at most, "
        f"{100.0 * error / max(largest.max(), 1e-300):.2g} % of the largest displacement"
    )
    if out:
        lines.append(f"shapes of all rows: {write_history(out, problem, u)}")
    return Answer(
        {"scene": problem.name, "rows": columns, "half_steps_mm": error}, "\n".join(lines)
    )


def _simulate_states(problem: ForwardProblem, theta: jax.Array) -> Answer:
    """Solve each state of a specimen, and return its volume ratios and stresses."""
    import numpy as np

    from emulator.fem.energy import volume_ratio
    from emulator.fem.outcome import described
    from emulator.specimens.homogeneous import homogeneous, homogeneous_stresses
    from emulator.specimens.specimen import require_specimen

    specimen = require_specimen(problem)
    states = homogeneous(specimen)
    solution = states.solve(theta)
    J = np.asarray(volume_ratio(specimen, solution.displacement))
    P = np.asarray(homogeneous_stresses(specimen, solution.displacement, theta)[1])
    result = described(specimen, theta, solution)
    result |= {"J_range": [float(J.min()), float(J.max())], "stresses_kPa": P.tolist()}
    lines = [
        f"{specimen.name}: {result['status']}, {len(J)} states",
        f"J from {J.min():.4f} to {J.max():.4f}, stress up to {np.abs(P).max():.4g} kPa",
    ]
    return Answer(result, "\n".join(lines), bool(solution.converged))


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
    from emulator.fem.outcome import cavity_volumes, described, write_outcome
    from emulator.fem.unloading import Unloader
    from emulator.geometry.io import write_mesh

    scene = words.scene_of(arguments)
    theta = words.theta_of(arguments, scene)
    if arguments.out:
        check_folder(arguments.out)
    unloaded = Unloader(scene).solve(theta)
    result = described(scene, theta, unloaded)
    if not unloaded.converged:
        result["taken_off"] = {name: amount for name, (amount, _) in unloaded.taken_off.items()}
        return Answer(result, f"{_in_a_line(result)}\n{unloaded.limit}", usable=False)
    rest, start = unloaded.scene, np.asarray(unloaded.start)
    reloaded = Simulator(rest).solve(theta)
    status = Status(int(reloaded.status))
    missed = float(np.abs(reloaded.displacement - start).max())
    result |= {
        "largest_displacement": float(np.linalg.norm(unloaded.displacement, axis=1).max()),
        "volumes": {
            name: {"loaded_ml": volume["rest_ml"], "unloaded_ml": volume["volume_ml"]}
            for name, volume in cavity_volumes(scene, unloaded.displacement).items()
        },
        "reloaded": {
            "status": status.name.lower(),
            "residual": float(reloaded.residual),
            "missed": missed,
        },
    }
    lines = [_in_a_line(result), f"largest displacement {result['largest_displacement']:.6g} mm"]
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
        write_outcome(folder / LOADED, rest, unloaded.start, theta)
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
    words.engine_option(),
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
    plan["executor"] = arguments.engine
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
