"""Measured displacements in and out of files.

A CSV file has the columns ``node,ux,uy,uz`` (nodes of the mesh) or ``x,y,z,ux,uy,uz`` (material
points of the reference body), all lengths in mm. A netCDF file has a variable ``displacement``
with one row a point, and beside it either ``node`` or ``position`` (rows of x, y, z).
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import xarray as xr

from calibrate.observations import (
    NodalDisplacements,
    Observation,
    landmarks,
    nodal_displacements,
)
from emulator.errors import InputError
from emulator.scenes.scene import Scene
from emulator.store import write_atomically

_U = ["ux", "uy", "uz"]
_X = ["x", "y", "z"]


def read_data(scene: Scene, path: str | Path) -> tuple[Observation, np.ndarray]:
    """The observation a file stands for and its displacements (d, 3) in mm.

    Raises
    ------
    InputError
        Missing or malformed file, a value that is not finite, an unknown node, a point outside.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"data file {path} does not exist")
    where, values = _read_csv(path) if path.suffix.lower() == ".csv" else _read_netcdf(path)
    if values.ndim != 2 or values.shape[1] != 3 or not len(values):
        raise InputError(
            f"data file {path}: displacements have shape {values.shape}; expected (d, 3)"
        )
    for what, array in (("position", where), ("displacement", values)):
        bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(
                f"data file {path}: row {row + 1} has a {what} that is not finite; repair it"
            )
    try:
        if where.ndim == 1:
            if (where != np.round(where)).any():
                raise InputError("nodes must be whole numbers")
            return nodal_displacements(scene, where.astype(int)), values
        return landmarks(scene, where), values
    except InputError as error:
        raise InputError(f"data file {path}: {error}") from error


def _read_csv(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"data file {path} is not a CSV file: {error}") from error
    columns = set(rows[0]) if rows else set()
    names = ["node"] if "node" in columns else _X
    missing = [name for name in (*names, *_U) if name not in columns]
    if missing:
        raise InputError(
            f"data file {path}: column '{missing[0]}' is missing; "
            "expected node,ux,uy,uz or x,y,z,ux,uy,uz"
        )
    table = np.array(
        [[_number(path, k, row, name) for name in (*names, *_U)] for k, row in enumerate(rows)]
    )
    where = table[:, : len(names)]
    return (where[:, 0] if names == ["node"] else where), table[:, len(names) :]


def _number(path: Path, row: int, values: dict[str, str | None], name: str) -> float:
    try:
        return float(values[name] or "")
    except ValueError as error:
        raise InputError(
            f"data file {path}: row {row + 1}, column '{name}' is '{values[name]}', not a number"
        ) from error


def _read_netcdf(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            data = file.load()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"data file {path} is neither CSV (.csv) nor readable netCDF") from error
    for name in ("node", "position"):
        if name in data.variables and "displacement" in data.variables:
            return np.asarray(data[name], dtype=float), np.asarray(
                data["displacement"], dtype=float
            )
    raise InputError(
        f"data file {path}: needs variables displacement and node, or displacement and position"
    )


def write_data(path: str | Path, observe: Observation, values: np.ndarray) -> None:
    """Write displacements (d, 3) in mm as CSV."""
    nodal = isinstance(observe, NodalDisplacements)
    where = observe.nodes[:, None] if nodal else observe.points
    lines = [",".join((["node"] if nodal else _X) + _U)]
    for place, value in zip(where.tolist(), np.asarray(values).tolist(), strict=True):
        lines.append(",".join(map(repr, [*place, *value])))
    write_atomically(path, ("\n".join(lines) + "\n").encode())
