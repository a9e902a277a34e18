"""Tables of runs: columns of a CSV file or a spreadsheet, or arrays of a netCDF or Zarr file.

An array's first dimension is the runs, as xarray and most campaigns write them; an array of more
dimensions is a field, whose numbers follow each other as they lie in the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.cells import read_cells
from emulator.core.errors import InputError
from emulator.core.units import with_unit

_NETCDF = (".nc", ".nc4", ".h5", ".hdf5")


@dataclass(frozen=True)
class RunTable:
    """A table with a row for each run.

    path : the file, or the folder of a Zarr store.
    rows : the number (c,) of each row, as messages name it.
    sizes : the count of numbers in each row of a column, by the column's word.
    units : the unit of a column, by its word, where the table says it.
    read : the function of a word and whether numbers may be missing that returns the column
        (c, size), NaN where a number is missing; :class:`InputError` for text.
    """

    path: Path
    rows: np.ndarray
    sizes: Mapping[str, int]
    units: Mapping[str, str]
    read: Callable[[str, bool], np.ndarray]

    def column(self, word: str, *, gaps: bool = False) -> np.ndarray:
        """Return a column (c, size); :class:`InputError` for one that is not there, or text."""
        if word not in self.sizes:
            raise InputError(f"{self.path}: there is no column '{word}', but {self.listed()}")
        return self.read(word, gaps)

    def listed(self) -> str:
        """Return the words of the columns, for a message."""
        return ", ".join(self.sizes)


def read_runs(path: Path) -> RunTable:
    """Return a table of runs; :class:`InputError` for a file that is none."""
    if path.suffix.lower() in _NETCDF or path.is_dir():
        return _of_arrays(path)
    cells = read_cells(path)
    units = {word: unit for word in cells.words if (unit := with_unit(word)[1])}

    def read(word: str, gaps: bool) -> np.ndarray:
        return np.array([[cells.number(k, word, gaps=gaps)] for k in cells.rows])

    return RunTable(path, np.array(list(cells.rows)), dict.fromkeys(cells.words, 1), units, read)


def _of_arrays(path: Path) -> RunTable:
    import xarray as xr

    try:
        of_folder: dict[str, Any] = {}
        if path.is_dir():
            of_folder = {"engine": "zarr", "consolidated": False}
        with xr.open_dataset(path, decode_times=False, **of_folder) as opened:
            arrays = opened.load()
    except Exception as error:  # each library of a format raises its own
        fault = str(error).partition("\n")[0]
        raise InputError(f"{path} is not a readable netCDF or Zarr file: {fault}") from None
    first = [v.dims[0] for v in arrays.variables.values() if v.ndim == 1]
    if not first:
        raise InputError(f"{path} has no array of one dimension, the runs; parameters are such")
    runs = max(dict.fromkeys(first), key=first.count)
    columns = {
        str(name): variable
        for name, variable in arrays.variables.items()
        if variable.ndim and variable.dims[0] == runs and name != runs
    }
    units = {n: str(v.attrs["units"]) for n, v in columns.items() if v.attrs.get("units")}

    def read(word: str, gaps: bool) -> np.ndarray:
        try:
            values = np.asarray(columns[word].values, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"{path}: '{word}' is text, not numbers") from None
        missing = ~np.isfinite(values.reshape(len(values), -1))
        if missing.any() and not gaps:
            row = int(np.flatnonzero(missing.any(axis=1))[0])
            raise InputError(f"{path}: row {row + 1}, '{word}' is not finite")
        return values.reshape(len(values), -1)

    sizes = {name: int(np.prod(v.shape[1:], dtype=int)) for name, v in columns.items()}
    return RunTable(path, np.arange(1, arrays.sizes[runs] + 1), sizes, units, read)


def content_of(path: Path) -> str:
    """Return a hash of a table's content, of all files of a Zarr store."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    content = hashlib.sha256()
    for file in files:
        content.update(str(file.relative_to(path)).encode() + b"\0" if file != path else b"")
        content.update(file.read_bytes())
    return content.hexdigest()
