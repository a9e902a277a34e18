"""``calibrate unload``: the stress-free shape of a body that is known under load."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import (
    DONE,
    FAILED,
    add_scene,
    add_theta,
    assignments,
    emit,
    scene_words,
)
from calibrate.cli.volumes import volumes

if TYPE_CHECKING:
    from emulator.fem.unloading import Unloaded
    from emulator.scenes.scene import Scene

MESH, LOADED = "unloaded.vtu", "loaded.vtu"
_MISSED = 1e-6  # of the body's size, by which the shape loaded again may miss the mesh


def register(commands: Any) -> None:
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


def run(arguments: argparse.Namespace) -> int:
    """Unload, load again, print both, write the files."""
    from emulator.catalogue import find_scene
    from emulator.core.store import check_folder
    from emulator.fem import Status
    from emulator.fem.unloading import Unloader

    scene = find_scene(*scene_words(arguments))
    theta = scene.theta(**assignments(arguments.theta)) if arguments.theta else scene.centre
    if arguments.out:
        check_folder(arguments.out)
    unloaded = Unloader(scene).solve(theta)
    status = Status(int(unloaded.status))
    result: dict[str, Any] = {
        "scene": scene.name,
        "theta": dict(zip(scene.parameter_names, map(float, theta), strict=True)),
        "status": status.name.lower(),
        "iterations": int(unloaded.iterations),
        "residual": float(unloaded.residual),
        "load_reached": float(unloaded.load_reached),
    }
    lines = [f"{scene.name}: {status.text}, {result['iterations']} Newton iterations"]
    found = status is Status.CONVERGED
    if found:
        found = _told(scene, unloaded, theta, result, lines)
    if found and arguments.out:
        _write(Path(arguments.out), unloaded, theta)
        result["out"] = arguments.out
        lines.append(f"written to {arguments.out}: {MESH}, {LOADED}")
    emit(result, as_json=arguments.json, text="\n".join(lines))
    return DONE if found else FAILED


def _told(
    scene: Scene, unloaded: Unloaded, theta: Any, result: dict[str, Any], lines: list[str]
) -> bool:
    """Whether the shape, loaded from rest, is the mesh; what there is to say of it."""
    import numpy as np

    from emulator.fem import Simulator, Status

    w = np.asarray(unloaded.displacement)
    simulator = Simulator(unloaded.scene)
    again = simulator.solve(theta)
    status = Status(int(again.status))
    missed = float(np.abs(again.displacement - unloaded.start).max())
    cavities = {
        name: {"loaded_ml": each["rest_ml"], "unloaded_ml": each["volume_ml"]}
        for name, each in volumes(scene, unloaded.displacement).items()
    }
    result |= {
        "largest_displacement": float(np.linalg.norm(w, axis=1).max()),
        "volumes": cavities,
        "reloaded": {
            "status": status.name.lower(),
            "residual": float(again.residual),
            "missed": missed,
        },
    }
    lines.append(f"largest displacement {result['largest_displacement']:.6g} mm")
    lines += [
        f"cavity '{name}': {each['unloaded_ml']:.6g} mL, under load {each['loaded_ml']:.6g} mL"
        for name, each in cavities.items()
    ]
    lines.append(
        f"loaded again from rest: {status.text}, residual {again.residual:.1e}, "
        f"{missed:.1e} mm from the mesh"
    )
    met = status is Status.CONVERGED and missed <= _MISSED * scene.mesh.size
    if not met:
        lines.append(
            "loading leads elsewhere: tissue this soft would not stay in the mesh's shape; look at "
            "theta"
        )
    return met


def _write(folder: Path, unloaded: Unloaded, theta: Any) -> None:
    """The mesh for a scene file, and the body under its loads for a picture."""
    import numpy as np

    from emulator.fem.fields import element_fields
    from emulator.geometry.io import write_mesh, write_solution

    scene = unloaded.scene
    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(folder / MESH, scene.mesh, scene.fibres, scene.sheets)
    fields = element_fields(scene, unloaded.start, theta)
    write_solution(folder / LOADED, scene.mesh, np.asarray(unloaded.start), fields)
