"""``calibrate frames``: surfaces of an image's frames, or a full field, as data."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calibrate.cli import words
from calibrate.cli.output import table
from calibrate.cli.words import Answer, command, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder


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
    """Measure the surfaces, and write the data."""
    from calibrate.measurements.data import write_data
    from calibrate.measurements.frame_checks import frame_doubts
    from calibrate.measurements.frames import frame_data
    from calibrate.state_names import states_of
    from emulator.core.errors import look_up
    from emulator.core.units import IN_MM
    from emulator.hearts.surfaces import read_surface

    check_folder(Path(arguments.out).parent)
    if bool(arguments.field) is bool(arguments.surface):
        raise InputError("frames: give either --surface or --field")
    if arguments.field:
        return _full_field(arguments)
    look_up(IN_MM, arguments.unit, "unit")
    states_of((word.partition("=")[0] for word in arguments.surface), "surfaces")
    surfaces = {}
    for word in arguments.surface:
        name, equals, path = word.partition("=")
        if not (name and equals and path) or name in surfaces:
            raise InputError(
                f"--surface '{word}'; give each as SET@STATE=FILE, such as lv_endocardium@es=lv.obj"
            )
        surfaces[name] = read_surface(path, name, IN_MM[arguments.unit])
    scene = words.scene_of(arguments)
    observe, data = frame_data(scene, surfaces, arguments.points)
    doubts = [*frame_doubts(scene.mesh, surfaces, observe, data)]
    write_data(arguments.out, observe, data)
    return _measured(data, arguments.out, doubts)


def _full_field(arguments: Namespace) -> Answer:
    """Read a full field and the force beside it, and write the data."""
    import numpy as np

    from calibrate.measurements import parse_observation
    from calibrate.measurements.collection import observations
    from calibrate.measurements.data import write_data
    from calibrate.measurements.full_field import (
        field_data,
        field_doubts,
        read_amounts,
        read_curve,
        read_full_field,
        sign_of,
        spread_points,
    )
    from calibrate.state_names import in_state

    scene = words.scene_of(arguments)
    if arguments.amount is None or len(arguments.field) > 2:
        raise InputError("--field: give one or two files, and --amount PARAMETER=FILE:COLUMN")
    parameter, path, column = _split(arguments.amount, "--amount", "PARAMETER=FILE:COLUMN")
    field = read_full_field(*arguments.field)
    amounts = read_amounts(path, column)
    sign = sign_of(scene, parameter, amounts)
    amounts = {frame: sign * amount for frame, amount in amounts.items()}
    loaded_frames = [frame for frame in field.frames if amounts.get(frame) != 0.0]
    count = min(arguments.points, len(field.points))
    field = field.only(arguments.only or loaded_frames, spread_points(field.points, count))
    doubts = [*field_doubts(scene, field, amounts, parameter)]
    observe, data = field_data(scene, field, amounts)
    parts = dict(observe.parts)
    for curve in arguments.force:
        usage = "REACTION=FILE:AMOUNT:COLUMN"
        word, path, *columns = _split(curve, "--force", usage)
        at, force = read_curve(path, columns[0], columns[1], list(amounts.values()))
        ((name, part),) = parse_observation(scene, word, 0).parts.items()
        if in_state(name, field.frames[0]) in parts:
            raise InputError(f"--force: {word} is given twice; give one curve for each")
        for frame in field.frames:
            if not at[0] <= amounts[frame] <= at[-1]:
                raise InputError(
                    f"--force: {path} goes from {at[0]:.4g} to {at[-1]:.4g}, frame '{frame}' is at "
                    f"{amounts[frame]:.4g}"
                )
            parts[in_state(name, frame)] = part
            data[in_state(name, frame)] = np.array(np.interp(amounts[frame], at, force))
    known = {in_state(parameter, frame): amounts[frame] for frame in field.frames}
    write_data(arguments.out, observations(parts), data, known)
    return _measured(data, arguments.out, doubts)


def _split(word: str, flag: str, usage: str) -> list[str]:
    """Return NAME, FILE and the columns of ``NAME=FILE:COLUMN``."""
    name, equals, rest = word.partition("=")
    parts = [name, *rest.rsplit(":", usage.count(":"))]
    if not equals or len(parts) != usage.count(":") + 2 or not all(parts):
        raise InputError(f"{flag} '{word}'; give {usage}")
    return parts


def _measured(data: Mapping[str, Any], out: str, doubts: list[str]) -> Answer:
    """Return a table of the measured data, and what is doubtful about them."""
    import numpy as np

    rows, result = [], {}
    for name, values in data.items():
        known = values[np.isfinite(values)]
        of = {
            "mean": float(known.mean()),
            "sd": float(known.std()),
            "missing": int(np.isnan(values).sum()),
        }
        result[name] = of
        rows.append((name, f"{of['mean']:.4g}", f"{of['sd']:.3g}", of["missing"]))
    text = table(("data", "mean (mm, mL, N)", "sd", "missing"), rows)
    lines = [text, *doubts, f"written to {out}"]
    return Answer({"out": out, "data": result, "warnings": doubts}, "\n".join(lines))
