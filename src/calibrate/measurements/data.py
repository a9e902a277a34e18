"""Reading and writing measurements.

A CSV file has the columns ``node,ux,uy,uz`` (nodes of the mesh) or ``x,y,z,ux,uy,uz`` (material
points of the reference body), all lengths in mm. The volume of a cavity is one more column,
``volume`` (mL; ``volume:<facet set>`` where the scene has several cavities), filled in one row
only, which may be a row of its own. There may be a volume and no displacement. A missing value is
an empty cell, ``NA`` or ``nan``; it is read as NaN.

A netCDF file has a variable ``displacement`` with one row a point, and beside it either ``node`` or
``position`` (rows of x, y, z); and a number ``volume``, or ``volume:<facet set>``.

Of a body in several load states, a CSV file has a column ``state`` with the state's name in every
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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from calibrate.measurements import (
    OBSERVATIONS,
    Field,
    Kind,
    Observation,
    Observations,
    observations,
)
from calibrate.measurements.files import Block, DataFile, open_data, write_csv, write_netcdf
from calibrate.measurements.present import check_some
from calibrate.state_names import in_state, split
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene

Files = str | Path | Mapping[str, str]
"""A data file, or the file of each load state by the state's name."""


def read_data(scene: Scene, files: Files) -> tuple[Observations, dict[str, np.ndarray]]:
    """Observations of a file and their data, by the same names (:func:`read_measurements`)."""
    observe, data, _ = read_measurements(scene, files)
    return observe, data


def read_measurements(
    scene: Scene, files: Files
) -> tuple[Observations, dict[str, np.ndarray], dict[str, float]]:
    """Observations of a file, their data by the same names, and its known parameters.

    Of several files, by load state, each has the data of its state; one with states of its own,
    such as a loading curve ``pull``, those of ``pull.1``, ``pull.2`` and so on. Known parameters
    are those of columns ``known:NAME``, by ``parameter@state``.

    Raises
    ------
    InputError
        Missing or malformed file, a place that is not finite, an infinite value, an unknown node, a
        point outside, an unknown cavity, a known value that differs within one load state.
    """
    parts: dict[str, Observation] = {}
    data: dict[str, np.ndarray] = {}
    known: dict[str, float] = {}
    equal: dict[str, Observation] = {}
    for path, state, rows in _states(files):
        known |= _known(state, rows)
        layouts = _found(path, rows)
        for base, (kind, fields) in layouts.items():
            others = _others_there(fields, [f for _, f in layouts.values()])
            name, arrays = in_state(base, state), rows.arrays(fields, others)
            try:
                part, data[name] = kind.from_arrays(scene, base, arrays)
                # One object for all states in which the same was observed: one program for them.
                parts[name] = equal.setdefault(json.dumps(part.to_json()), part)
                parts[name].check(name, data[name])
                check_some(base, data[name])
            except InputError as error:
                where = f", state '{state}'" if state else ""
                raise InputError(f"data file {path}{where}: {error}") from error
    return Observations(parts), data, known


def read_known(files: Files) -> dict[str, float]:
    """Known parameters of a data file by ``parameter@state``, from its columns ``known:NAME``.

    Raises
    ------
    InputError
        A value that is no number, or differs within one load state.
    """
    known: dict[str, float] = {}
    for _, state, rows in _states(files):
        known |= _known(state, rows)
    return known


def _known(state: str, rows: DataFile) -> dict[str, float]:
    return {in_state(parameter, state): value for parameter, value in rows.known().items()}


def _states(files: Files) -> Iterator[tuple[Path, str, DataFile]]:
    """Path, load state and content of each file and state."""
    if not isinstance(files, Mapping):
        for state, rows in open_data(Path(files)).states().items():
            yield Path(files), state, rows
        return
    for name, file in files.items():
        if not name or set("@/+") & set(name):
            raise InputError(f"data: load state '{name}'; give it a name without @, / and +")
        for state, rows in open_data(Path(file)).states().items():
            yield Path(file), f"{name}.{state}" if state else name, rows


def _others_there(fields: Sequence[Field], every: Iterable[Sequence[Field]]) -> set[str]:
    """Columns measured by other observations that share columns of places with ``fields``."""
    places = {word for field in fields if field.where for word in field.columns}
    return {
        word
        for others in every
        if others != fields and places & {w for field in others for w in field.columns}
        for field in others
        if not field.where
        for word in field.columns
    }


def _found(path: Path, file: DataFile) -> dict[str, tuple[type[Kind], tuple[Field, ...]]]:
    """Kind and fields of each observation that the file has all columns of, by name."""
    found: dict[str, tuple[type[Kind], tuple[Field, ...]]] = {}
    partly: list[list[str]] = []
    used: set[str] = set()
    for kind in OBSERVATIONS.values():
        for name, fields in kind.layouts(file.words).items():
            words = [word for field in fields for word in file.needs(field)]
            if not set(words) <= set(file.words):
                partly.append(words)
            elif name not in found:
                found[name] = kind, fields
                used.update(words)
    # An incomplete observation is refused; otherwise its columns would be silently ignored.
    partly = [words for words in partly if set(words) & set(file.words) - used]
    if partly or not found:
        lacking = [[w for w in words if w not in file.words] for words in partly]
        missing = f"{file.what} '{min(lacking, key=len)[0]}' is missing" if partly else "no data"
        raise InputError(f"data file {path}: {missing}; expected {_expected(file)}")
    return found


def _expected(file: DataFile) -> str:
    """The columns or variables of every kind, for error messages."""
    every = [
        ",".join(word for field in fields for word in file.needs(field))
        for name, kind in OBSERVATIONS.items()
        for fields in kind.layouts((name,)).values()
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
        arrays = part.to_arrays(base, np.asarray(data[name]))
        fields = OBSERVATIONS[part.to_json()["kind"]].layouts((base, *arrays))[base]
        states[state].append([(field, arrays[field.variable]) for field in fields])
    write = write_netcdf if Path(path).suffix.lower() == ".nc" else write_csv
    write(path, states)
