"""Measurements in and out of files.

A CSV file has the columns ``node,ux,uy,uz`` (nodes of the mesh) or ``x,y,z,ux,uy,uz`` (material
points of the reference body), all lengths in mm. The volume of a cavity is one more column,
``volume`` (mL; ``volume:<facet set>`` where the scene has several cavities), filled in one row
only, which may be a row of its own. There may be a volume and no displacement.

A netCDF file has a variable ``displacement`` with one row a point, and beside it either ``node`` or
``position`` (rows of x, y, z); and a number ``volume``, or ``volume:<facet set>``.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from calibrate.observations import (
    CavityVolume,
    Landmarks,
    NodalDisplacements,
    Observation,
    Observations,
    landmarks,
    nodal_displacements,
    observations,
)
from emulator.errors import InputError
from emulator.scenes.scene import Scene
from emulator.store import write_atomically

DISPLACEMENT, VOLUME = "displacement", "volume"
_U = ["ux", "uy", "uz"]
_X = ["x", "y", "z"]


class _Content(NamedTuple):
    """where : (d,) nodes or (d, 3) mm; both empty without displacements. volumes : mL by name."""

    where: np.ndarray
    displacement: np.ndarray
    volumes: dict[str, float]


def is_volume(name: str) -> bool:
    """Whether ``name`` is ``volume`` or ``volume:<facet set>``."""
    return name.partition(":")[0] == VOLUME


def volume_of(scene: Scene, name: str) -> CavityVolume:
    """The cavity volume that ``volume`` or ``volume:<facet set>`` stands for."""
    return CavityVolume(scene, name.partition(":")[2] or None)


def read_data(scene: Scene, path: str | Path) -> tuple[Observations, dict[str, np.ndarray]]:
    """What a file has observed and the data, by the same names.

    Raises
    ------
    InputError
        Missing or malformed file, a value that is not finite, an unknown node, a point outside, an
        unknown cavity.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"data file {path} does not exist")
    content = _read_csv(path) if path.suffix.lower() == ".csv" else _read_netcdf(path)
    try:
        return _observed(scene, content)
    except InputError as error:
        raise InputError(f"data file {path}: {error}") from error


def _observed(scene: Scene, content: _Content) -> tuple[Observations, dict[str, np.ndarray]]:
    parts: dict[str, Observation] = {}
    data: dict[str, np.ndarray] = {}
    if len(content.displacement) or not content.volumes:
        parts[DISPLACEMENT] = _displacements(scene, content.where, content.displacement)
        data[DISPLACEMENT] = content.displacement
    for name, value in content.volumes.items():
        if not 0.0 < value < np.inf:
            raise InputError(f"{name} is {value} mL; it must be above 0 and finite")
        parts[name], data[name] = volume_of(scene, name), np.asarray(value)
    return Observations(parts), data


def _displacements(
    scene: Scene, where: np.ndarray, values: np.ndarray
) -> NodalDisplacements | Landmarks:
    if values.ndim != 2 or values.shape[1] != 3 or not len(values):
        raise InputError(f"displacements have shape {values.shape}; expected (d, 3)")
    for what, array in (("position", where), ("displacement", values)):
        bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"row {row + 1} has a {what} that is not finite; repair it")
    if where.ndim > 1:
        return landmarks(scene, where)
    if (where != np.round(where)).any():
        raise InputError("nodes must be whole numbers")
    return nodal_displacements(scene, where.astype(int))


def _read_csv(path: Path) -> _Content:
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"data file {path} is not a CSV file: {error}") from error
    columns = list(rows[0]) if rows else []
    volumes = _csv_volumes(path, rows, [name for name in columns if name and is_volume(name)])
    names = [*(["node"] if "node" in columns else _X), *_U]
    if volumes and not set(names) & set(columns):
        return _Content(np.empty(0), np.empty((0, 3)), volumes)
    missing = [name for name in names if name not in columns]
    if missing:
        raise InputError(
            f"data file {path}: column '{missing[0]}' is missing; "
            "expected node,ux,uy,uz or x,y,z,ux,uy,uz, or a volume"
        )
    # A row that holds a volume and nothing else is no point.
    points = [(k, row) for k, row in enumerate(rows) if not volumes or any(row[n] for n in names)]
    table = np.array([[_number(path, k, row, name) for name in names] for k, row in points])
    table = table.reshape(len(points), len(names))
    where = table[:, :-3]
    return _Content(where[:, 0] if names[0] == "node" else where, table[:, -3:], volumes)


def _csv_volumes(
    path: Path, rows: list[dict[str, str | None]], names: list[str]
) -> dict[str, float]:
    volumes = {}
    for name in names:
        filled = [k for k, row in enumerate(rows) if (row[name] or "").strip()]
        if len(filled) != 1:
            raise InputError(
                f"data file {path}: column '{name}' has {len(filled)} values; give one, in mL"
            )
        volumes[name] = _number(path, filled[0], rows[filled[0]], name)
    return volumes


def _number(path: Path, row: int, values: Mapping[str, str | None], name: str) -> float:
    try:
        return float(values[name] or "")
    except ValueError as error:
        raise InputError(
            f"data file {path}: row {row + 1}, column '{name}' is '{values[name]}', not a number"
        ) from error


def _read_netcdf(path: Path) -> _Content:
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            data = file.load()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"data file {path} is neither CSV (.csv) nor readable netCDF") from error
    volumes = {}
    for name in filter(is_volume, map(str, data.variables)):
        if data[name].size != 1:
            raise InputError(
                f"data file {path}: {name} has shape {data[name].shape}; give one number, in mL"
            )
        volumes[name] = float(data[name].item())
    places = [name for name in ("node", "position") if name in data.variables]
    if volumes and DISPLACEMENT not in data.variables:
        return _Content(np.empty(0), np.empty((0, 3)), volumes)
    if not places or DISPLACEMENT not in data.variables:
        raise InputError(
            f"data file {path}: needs variables displacement and node, or displacement and "
            "position, or volume"
        )
    where, values = (np.asarray(data[name], dtype=float) for name in (places[0], DISPLACEMENT))
    return _Content(where, values, volumes)


def write_data(
    path: str | Path,
    observe: Observation | Observations,
    values: np.ndarray | Mapping[str, np.ndarray],
) -> None:
    """Write data as CSV: displacements (d, 3) in mm of at most one observation, volumes in mL.

    Raises
    ------
    InputError
        Observations that no file of this kind can hold.
    """
    observe = observations(observe)
    data = observe.name(values, "data")
    volumes = {n: data[n] for n, part in observe.parts.items() if isinstance(part, CavityVolume)}
    places = [n for n in observe.parts if n not in volumes]
    if places not in ([], [DISPLACEMENT]) or not all(map(is_volume, volumes)):
        raise InputError(
            f"observations {', '.join(observe.parts)} do not fit in one CSV file; it holds "
            f"'{DISPLACEMENT}', and volumes called '{VOLUME}' or '{VOLUME}:<facet set>'"
        )
    header: list[str] = []
    rows: list[list[str]] = []
    for part in (observe.parts[name] for name in places):
        assert isinstance(part, NodalDisplacements | Landmarks)
        header, rows = _csv_points(part, data[DISPLACEMENT])
    blank = [""] * len(header)
    rows = [[*row, *([""] * len(volumes))] for row in rows]
    if volumes:
        rows.append([*blank, *(repr(float(value)) for value in volumes.values())])
    lines = [",".join(row) for row in ([*header, *volumes], *rows)]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _csv_points(
    observe: NodalDisplacements | Landmarks, values: np.ndarray
) -> tuple[list[str], list[list[str]]]:
    """Header and rows of displacements (d, 3)."""
    nodal = isinstance(observe, NodalDisplacements)
    where = observe.nodes[:, None] if nodal else observe.points
    rows = zip(where.tolist(), np.asarray(values).tolist(), strict=True)
    return [*(["node"] if nodal else _X), *_U], [
        [repr(number) for number in (*place, *value)] for place, value in rows
    ]
