"""Reading and writing measurements.

A CSV file has the columns ``node,ux,uy,uz`` (nodes of the mesh) or ``x,y,z,ux,uy,uz`` (material
points of the reference body), all lengths in mm. The volume of a cavity is one more column,
``volume`` (mL; ``volume:<facet set>`` where the scene has several cavities), filled in one row
only, which may be a row of its own. There may be a volume and no displacement. A missing value is
an empty cell, ``NA`` or ``nan``; it is read as NaN.

A netCDF file has a variable ``displacement`` with one row a point, and beside it either ``node`` or
``position`` (rows of x, y, z); and a number ``volume``, or ``volume:<facet set>``.

For a body in several load states, a CSV file has a column ``state`` with the state's name in every
row, and a netCDF file variables such as ``volume@diastole``.

A parameter that is known exactly in a load state, such as the amount of a motion, is a column
``known:NAME``, the same number in every row of the state or given once. A CSV file
with such columns and neither ``state`` nor places is a loading curve: each row is a load state,
named by its number.

Each kind of observation (``calibrate.measurements.OBSERVATIONS``) names its own columns and
variables.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from calibrate.measurements.collection import Observations, check_some, observations
from calibrate.measurements.observation import Block, Observation, Table
from calibrate.measurements.registry import OBSERVATIONS
from calibrate.measurements.tables import DataTable, open_data, write_csv, write_netcdf
from calibrate.state_names import in_state, split
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene

Files = str | Path | Mapping[str, str]
"""A data file, or the file of each load state by the state's name."""


def read_data(scene: Scene, files: Files) -> tuple[Observations, dict[str, np.ndarray]]:
    """Return the observations of a file and their data; see :func:`read_measurements`."""
    observe, data, _ = read_measurements(scene, files)
    return observe, data


def read_measurements(
    scene: Scene, files: Files
) -> tuple[Observations, dict[str, np.ndarray], dict[str, float]]:
    """Return the observations of a file, their data by the same names, and known parameters.

    Of several files, by load state, each has the data of its state. A file with states of its own,
    such as a loading curve ``pull``, has those of ``pull.1``, ``pull.2`` and so on. Parameters are
    known from columns ``known:NAME``, and returned by ``parameter@state``.

    Raises
    ------
    InputError
        Missing or malformed file, a place that is not finite, an infinite value, an unknown node, a
        point outside, an unknown cavity, a known value that differs within one load state.
    """
    parts: dict[str, Observation] = {}
    data: dict[str, np.ndarray] = {}
    known: dict[str, float] = {}
    distinct: dict[str, Observation] = {}
    for path, state, file in _states(files):
        known |= {in_state(parameter, state): value for parameter, value in file.known().items()}
        tables = _tables(path, file)
        for base, (kind, table) in tables.items():
            name = in_state(base, state)
            arrays = file.arrays(table.fields, _others(table, [t for _, t in tables.values()]))
            try:
                part, data[name] = kind.read(scene, base, table, arrays)
                # One object for all states in which the same was observed: one program for them.
                parts[name] = distinct.setdefault(json.dumps(part.to_json()), part)
                parts[name].check(name, data[name])
                check_some(base, data[name])
            except InputError as error:
                where = f", state '{state}'" if state else ""
                raise InputError(f"data file {path}{where}: {error}") from error
    return Observations(parts), data, known


def _states(files: Files) -> Iterator[tuple[Path, str, DataTable]]:
    """Yield the path, load state and content of each file and state."""
    if not isinstance(files, Mapping):
        for state, table in open_data(Path(files)).states().items():
            yield Path(files), state, table
        return
    for name, file in files.items():
        if not name or set("@/+") & set(name):
            raise InputError(f"data: load state '{name}'; give it a name without @, / and +")
        for state, table in open_data(Path(file)).states().items():
            yield Path(file), f"{name}.{state}" if state else name, table


def _others(table: Table, tables: Iterable[Table]) -> set[str]:
    """Return the columns of other observations that share columns of places with ``table``."""
    places = _columns(table, where=True)
    sharing = (t for t in tables if t is not table and places & _columns(t, where=True))
    return {word for other in sharing for word in _columns(other, where=False)}


def _columns(table: Table, *, where: bool) -> set[str]:
    return {word for field in table.fields if field.where is where for word in field.columns}


def _tables(path: Path, file: DataTable) -> dict[str, tuple[type[Observation], Table]]:
    """Return kind and table of each observation that the file has all columns of, by name."""
    complete: dict[str, tuple[type[Observation], Table]] = {}
    partial: list[list[str]] = []
    used: set[str] = set()
    for kind in OBSERVATIONS.values():
        for name, table in kind.tables(file.words).items():
            words = [word for field in table.fields for word in file.words_of(field)]
            if not set(words) <= set(file.words):
                partial.append(words)
            elif name not in complete:
                complete[name] = kind, table
                used.update(words)
    # An incomplete observation is refused; otherwise its columns would be silently ignored.
    partial = [words for words in partial if set(words) & set(file.words) - used]
    if partial or not complete:
        lacking = [[w for w in words if w not in file.words] for words in partial]
        fault = f"{file.what} '{min(lacking, key=len)[0]}' is missing" if partial else "no data"
        raise InputError(f"data file {path}: {fault}; expected {_expected(file)}")
    return complete


def _expected(file: DataTable) -> str:
    """Return the columns or variables of every kind, for error messages."""
    every = [
        ",".join(word for field in table.fields for word in file.words_of(field))
        for name, kind in OBSERVATIONS.items()
        for table in kind.tables((name,)).values()
    ]
    return f"{file.what}s {' or '.join(every)}"


def write_data(
    path: str | Path,
    observe: Observation | Observations,
    values: np.ndarray | Mapping[str, np.ndarray],
) -> None:
    """Write data by name: netCDF where ``path`` ends in ``.nc``, CSV otherwise.

    Raises
    ------
    InputError
        An observation under a name that its kind cannot have in a file.
    """
    observe = observations(observe)
    data = observe.name(values, "data")
    states: dict[str, list[Block]] = {state: [] for state in observe.states}
    for name, part in observe.parts.items():
        base, state = split(name)
        if base not in part.names:
            raise InputError(
                f"observation '{name}' does not fit in a data file; "
                f"there it would be called {' or '.join(part.names)}"
            )
        states[state].append(part.block(base, part.filled(np.asarray(data[name]))))
    write = write_netcdf if Path(path).suffix.lower() == ".nc" else write_csv
    write(path, states)
