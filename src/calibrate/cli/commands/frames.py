"""``calibrate frames``: surfaces of an image's frames, or a full field, as data."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli import words
from calibrate.cli.output import missing_in_words, table
from calibrate.cli.words import Answer, command, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene


@command(
    words.add_scene,
    option(
        "--surface",
        "SET@STATE=FILE",
        "the surface of a facet set in a frame, triangles; one for each set and frame",
        nargs="+",
        default=(),
    ),
    option(
        "--field",
        "FILE",
        "in place of surfaces, a full field: tables of points (point,x,y) and of their "
        "displacements (frame,point,ux,uy); or an .npz or a folder of text matrices",
        nargs="+",
        default=(),
    ),
    option(
        "--amount",
        "PARAMETER=FILE:COLUMN",
        "of a full field, what pulls the body: a parameter, and its table with a column frame",
    ),
    option(
        "--force",
        "REACTION=FILE:AMOUNT:COLUMN",
        "of a full field, forces (N) such as reaction:pad:x, each with its curve over the amount",
        nargs="+",
        default=(),
    ),
    option("--only", "FRAME", "frames of a full field that are data (default: all)", nargs="+"),
    option(
        "--points", "N", "points of a facet set or of a field (default: 60)", type=int, default=60
    ),
    option("--unit", "mm|cm|m|um", "of the surfaces' coordinates (default: mm)", default="mm"),
    option("--out", "FILE", "data to write, CSV or .nc", required=True),
    help="surfaces of an image's frames, or a full field, as data",
    description="Writes how far the surface of each frame is from the scene's mesh, along normals "
    "at evenly spread points, and the volume within each cavity, as infer --data takes them. Of a "
    "full field, as of image correlation: the displacements of points in each frame.",
    epilog="example: calibrate frames heart.toml --surface lv_endocardium@es=lv_010.obj "
    "epicardium@es=epi_010.obj --out frames.csv",
)
def frames(arguments: Namespace) -> Answer:
    """Measure the surfaces or read the full field, and write the data."""
    import numpy as np

    from calibrate.measurements.collection import leave_out_missing
    from calibrate.measurements.data import write_data
    from calibrate.measurements.labels import missing_places

    check_folder(Path(arguments.out).parent)
    if bool(arguments.field) is bool(arguments.surface):
        raise InputError("frames: give either --surface or --field")
    measure = _full_field if arguments.field else _surfaces
    observe, data, known, doubts = measure(words.scene_of(arguments), arguments)
    write_data(arguments.out, observe, data, known)
    missing = missing_places(leave_out_missing(observe, data)[0])
    result = {
        name: {
            "mean": float(np.mean(values[np.isfinite(values)])),
            "sd": float(np.std(values[np.isfinite(values)])),
            "missing": len(missing.get(name, ())),
        }
        for name, values in data.items()
    }
    rows = [(n, f"{of['mean']:.4g}", f"{of['sd']:.3g}", of["missing"]) for n, of in result.items()]
    lines = [table(("data", "mean (mm, mL, N)", "sd", "missing"), rows)]
    lines += [missing_in_words(*places) for places in missing.items()]
    lines += [*doubts, *([_THICKNESS] if arguments.force else ()), f"written to {arguments.out}"]
    return Answer({"out": arguments.out, "data": result, "warnings": doubts}, "\n".join(lines))


_THICKNESS = (
    "forces tell stiffness times thickness: the share by which the mesh's thickness may be off is "
    'an error of kind "gain" (docs/full_field.md)'
)
# Observations, data, known parameters, and sentences on what contradicts itself.
_Measured = tuple[Any, dict[str, Any], dict[str, float], list[str]]


def _surfaces(scene: Scene, arguments: Namespace) -> _Measured:
    import numpy as np

    from calibrate.measurements.frame_checks import frame_doubts
    from calibrate.measurements.frames import frame_data
    from calibrate.state_names import states_of
    from emulator.core.errors import look_up
    from emulator.core.units import IN_MM
    from emulator.hearts.surfaces import read_surface

    look_up(IN_MM, arguments.unit, "unit")
    states_of((word.partition("=")[0] for word in arguments.surface), "surfaces")
    surfaces = {}
    for word in arguments.surface:
        name, equals, path = word.partition("=")
        if not (name and equals and path):
            raise InputError(
                f"--surface '{word}'; give each as SET@STATE=FILE, such as lv_endocardium@es=lv.obj"
            )
        if name in surfaces:
            paths = [
                one.partition("=")[2] for one in arguments.surface if one.startswith(f"{name}=")
            ]
            raise InputError(f"--surface '{name}' is there twice, {' and '.join(paths)}; give one")
        surfaces[name] = read_surface(path, name, IN_MM[arguments.unit])
        for other, before in surfaces.items():
            if other != name and np.array_equal(before.points, surfaces[name].points):
                raise InputError(
                    f"--surface '{other}' and '{name}' are one surface, {path}; each frame and "
                    "wall has its own"
                )
    observe, data = frame_data(scene, surfaces, arguments.points)
    return observe, data, {}, [*frame_doubts(scene.mesh, surfaces, observe, data)]


def _full_field(scene: Scene, arguments: Namespace) -> _Measured:
    from calibrate.measurements.full_field import measured_field

    if arguments.amount is None or len(arguments.field) > 2:
        raise InputError("--field: give one or two files, and --amount PARAMETER=FILE:COLUMN")
    return measured_field(
        scene,
        arguments.field,
        _split(arguments.amount, "--amount", "PARAMETER=FILE:COLUMN"),
        [_split(word, "--force", "REACTION=FILE:AMOUNT:COLUMN") for word in arguments.force],
        frames=arguments.only,
        points=arguments.points,
    )


def _split(word: str, flag: str, usage: str) -> list[str]:
    """Return NAME, FILE and the columns of ``NAME=FILE:COLUMN``."""
    name, equals, rest = word.partition("=")
    parts = [name, *rest.rsplit(":", usage.count(":"))]
    if not equals or len(parts) != usage.count(":") + 2 or not all(parts):
        raise InputError(f"{flag} '{word}'; give {usage}")
    return parts
