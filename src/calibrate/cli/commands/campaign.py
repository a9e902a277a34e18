"""``calibrate campaign``: FEM over a design of theta, into a Zarr store."""

from __future__ import annotations

import argparse
import time
from typing import Any

from calibrate.cli.common import (
    DONE,
    FAILED,
    add_scene,
    add_scheduler,
    emit,
    scene_words,
    show_progress,
)


def register(commands: Any) -> None:
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
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--slopes", action="store_true", help="du/dtheta, too")
    parser.add_argument(
        "--load-steps", type=int, default=1, metavar="N", help="as for simulate (default 1)"
    )
    add_scheduler(parser, "solve")
    parser.add_argument("--out", required=True, metavar="STORE.zarr")


def run(arguments: argparse.Namespace) -> int:
    """Solve what the store lacks, and count."""
    from calibrate.project.campaigns import fill, question
    from emulator.catalogue import find_scene
    from emulator.core.errors import InputError
    from emulator.fem import NewtonOptions
    from emulator.fem.campaign.store import count_statuses

    began = time.perf_counter()
    if not arguments.out.endswith(".zarr"):
        raise InputError(f"--out {arguments.out}: the store's name must end in .zarr")
    asked = question(
        find_scene(*scene_words(arguments)),
        arguments.samples,
        design=arguments.design,
        seed=arguments.seed,
        slopes=arguments.slopes,
        options=NewtonOptions.load_steps(arguments.load_steps),
    )
    progress = show_progress(arguments)
    solved = fill(asked, arguments.out, scheduler=arguments.scheduler, progress=progress)
    counts = count_statuses(arguments.out)
    samples = sum(counts.values())
    seconds = time.perf_counter() - began
    result = {
        "out": arguments.out,
        "scene": asked.scene.name,
        "samples": samples,
        "solved_now": solved,
        "status": counts,
        "seconds": seconds,
    }
    said = ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in counts.items())
    text = (
        f"{asked.scene.name}, {samples} theta: {said}\n"
        f"{solved} solved now in {seconds:.0f} s, written to {arguments.out}"
    )
    emit(result, as_json=arguments.json, text=text)
    return DONE if counts.get("converged") else FAILED
