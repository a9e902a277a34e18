"""Data files as named arrays: CSV and spreadsheets (:mod:`emulator.core.cells`), and netCDF.

Which columns there are says :mod:`calibrate.measurements.data`; nodes and positions may not be
missing.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from calibrate.measurements.observation import Block, DataField, Layout
from calibrate.state_names import in_state, split, states_of
from emulator.core import store
from emulator.core.cells import TEXT, Cells, read_cells
from emulator.core.errors import InputError
from emulator.core.units import IN_KPA, IN_ML, IN_MM, IN_MN, factor, with_unit

STATE = "state"
"""Column of a CSV file that names the load state of a row."""

KNOWN = "known:"
"""Before a parameter's name: a column of its value, where that is known."""

_PLACES = {"node", "x", "segment"}  # columns of tables whose rows are places, not load states


@dataclass(frozen=True)
class CSVTable:
    """Columns of a table of text in one of its load states.

    cells : the columns and rows of that state.
    what : the word for a column, for errors.
    """

    cells: Cells
    what: str = "column"

    @property
    def path(self) -> Path:
        """The file."""
        return self.cells.path

    @property
    def words(self) -> Sequence[str]:
        """The names of the columns."""
        return self.cells.words

    @property
    def known(self) -> dict[str, float]:
        """Parameters that are known in this load state, from columns ``known:NAME``.

        :class:`InputError` for a value that is no number, or several that differ.
        """
        values: dict[str, float] = {}
        for word in (w for w in self.words if w.startswith(KNOWN)):
            name = word.removeprefix(KNOWN)
            for number in (number for number, row in self.cells.rows.items() if row[word]):
                value = self.cells.number(number, word)
                if values.setdefault(name, value) != value:
                    raise InputError(
                        f"data file {self.path}: row {number}, column '{word}' is {value}, and "
                        f"{values[name]} before it in the same load state"
                    )
        return values

    def words_of(self, layout: Layout) -> list[str]:
        """Return the words that hold an observation in a file of this format."""
        return [word for field in layout.fields for word in field.columns]

    def arrays(self, fields: Sequence[DataField], others: Collection[str]) -> dict[str, np.ndarray]:
        """Return arrays of numbers by variable, NaN where a measured value is missing.

        fields : the fields of an observation; the file has every word of theirs.
        others : columns of what other observations measured at the same places; a row without
            measured values of ``fields`` that has values there is theirs.
        """
        measured = [word for field in fields if not field.where for word in field.columns]
        places = [word for field in fields if field.where for word in field.columns]
        rows = [
            k
            for k, row in self.cells.rows.items()
            if any(row[w] for w in measured)
            or (any(row[w] for w in places) and not any(row[w] for w in others))
        ]
        arrays = {}
        for field in fields:
            words, gaps = field.columns, not field.where
            numbers = [[self.cells.number(k, word, gaps=gaps) for word in words] for k in rows]
            array = np.array(numbers, dtype=float).reshape(len(rows), len(words))
            arrays[field.variable] = array[:, 0] if len(words) == 1 else array
        return arrays


_UNITS = (
    (re.compile(r"volume(:.+)?"), "mL", IN_ML),
    (re.compile(r"u?[xyz]|length:.+"), "mm", IN_MM),
    (re.compile(r"reaction:.+"), "N", {unit: size / IN_MN["N"] for unit, size in IN_MN.items()}),
    (re.compile(r"known:.*pressure.*"), "kPa", IN_KPA),
)
"""Columns that may have units in brackets besides those of specimens, and the project's unit."""


def _with_known(cells: Cells, loads: Collection[str]) -> Cells:
    """Return a table with columns such as ``pressure [mmHg]`` as ``known:pressure [mmHg]``."""
    names = {w: KNOWN + w for w in cells.words if with_unit(w)[0] in loads}
    for word in set(names.values()) & set(cells.words):
        raise InputError(f"data file {cells.path}: column '{word}' is there twice")
    rows = {k: {names.get(w, w): c for w, c in row.items()} for k, row in cells.rows.items()}
    return cells._replace(words=[names.get(w, w) for w in cells.words], rows=rows)


def _without_units(cells: Cells) -> Cells:
    """Return a table with columns such as ``volume [L]`` in the project's units, without them."""
    conversions: dict[str, tuple[str, float]] = {}
    for word in cells.words:
        name, unit = with_unit(word)
        usual = next((entry for entry in _UNITS if entry[0].fullmatch(name)), None)
        if unit and usual is not None:
            if name in (*cells.words, *(known for known, _ in conversions.values())):
                raise InputError(f"data file {cells.path}: column '{name}' is there twice")
            conversions[word] = name, factor(word, unit, *usual[1:])
    if not conversions:
        return cells

    def converted(row: int, word: str, cell: str) -> tuple[str, str]:
        name, ratio = conversions.get(word, (word, 1.0))
        number = cells.number(row, word, gaps=True) if ratio != 1.0 else 0.0
        return name, cell if ratio == 1.0 or np.isnan(number) else repr(float(number * ratio))

    rows = {k: dict(converted(k, w, c) for w, c in row.items()) for k, row in cells.rows.items()}
    return cells._replace(words=[conversions.get(w, (w, 1.0))[0] for w in cells.words], rows=rows)


def read_csv(table: Path | Cells, loads: Collection[str] = ()) -> dict[str, CSVTable]:
    """Return the table of each load state, by the column ``state`` or a loading curve's rows.

    One empty name where the file names no state.

    loads : parameters of loads: a column of such a name has known values.
    """
    cells = table if isinstance(table, Cells) else read_cells(table)
    whole = _without_units(_with_known(cells, loads))
    words, rows = whole.words, whole.rows
    curve = any(w.startswith(KNOWN) for w in words) and not {STATE, *_PLACES} & set(words)
    if STATE not in words and not curve:
        return {"": CSVTable(whole)}
    states: dict[str, dict[int, Mapping[str, str]]] = {}
    for number, cell in rows.items():
        state = str(number) if curve else cell[STATE]
        if not state or "@" in state or "/" in state:
            raise InputError(
                f"data file {whole.path}: row {number}, column '{STATE}' is '{state}'; "
                "give every row the name of its load state, without @ and /"
            )
        states.setdefault(state, {})[number] = cell
    # A column that is empty in a state was not measured there.
    return {
        state: CSVTable(
            whole._replace(
                words=[w for w in words if w != STATE and any(row[w] for row in part.values())],
                rows=part,
            )
        )
        for state, part in states.items()
    }


@dataclass(frozen=True)
class NetCDFTable:
    """Variables and coordinates of a netCDF file in one load state, as a :class:`CSVTable` has.

    words : the names of the variables, without the state.
    data : the dataset.
    state : the load state whose variables these are, or an empty word.
    """

    path: Path
    words: Sequence[str]
    data: xr.Dataset
    state: str
    what: str = "variable"

    @property
    def known(self) -> dict[str, float]:
        """The numbers in the variables ``known:NAME``."""
        words = [word for word in self.words if word.startswith(KNOWN)]
        arrays = self.arrays([DataField(word, (word,), where=True) for word in words])
        for word, array in arrays.items():
            if np.shape(array) != ():
                raise InputError(f"data file {self.path}: variable '{word}' is not a number")
        return {word.removeprefix(KNOWN): float(array) for word, array in arrays.items()}

    def words_of(self, layout: Layout) -> list[str]:
        """Return the fields' variables."""
        return [field.variable for field in layout.fields]

    def arrays(
        self, fields: Sequence[DataField], others: Collection[str] = ()
    ) -> dict[str, np.ndarray]:
        """Return the variables as numbers."""
        arrays = {}
        for name in (field.variable for field in fields):
            try:
                arrays[name] = np.asarray(self.data[in_state(name, self.state)], dtype=float)
            except (TypeError, ValueError) as error:
                raise InputError(
                    f"data file {self.path}: variable '{name}' does not hold numbers"
                ) from error
        return arrays


def read_netcdf(path: Path) -> dict[str, NetCDFTable]:
    """Return the variables of each load state, by what follows ``@`` in their names."""
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            data = file.load()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"data file {path} is neither CSV ({', '.join(TEXT)}) nor readable netCDF"
        ) from error
    # Coordinates without values of their own belong to no state.
    variables = [str(word) for word in data.variables if word not in data.dims]
    return {
        state: NetCDFTable(
            path, [base for base, s in map(split, variables) if s == state], data, state
        )
        for state in states_of(variables, f"data file {path}")
    }


DataTable = CSVTable | NetCDFTable
"""Named arrays of a file, in one load state."""


def write_csv(path: str | Path, states: Mapping[str, Sequence[Block]]) -> None:
    """Write the columns of every block side by side, load state after load state.

    Blocks of one number share a row of their own, the last of their state. A block that shares a
    column with an earlier one, such as ``x``, has rows of its own below.
    """
    fields = [field for blocks in states.values() for block in blocks for field, _ in block]
    header = list(dict.fromkeys(word for field in fields for word in field.columns))
    named = "" not in states
    text = io.StringIO()
    writer = csv.DictWriter(text, [STATE] * named + header, lineterminator="\n")
    writer.writeheader()
    for state, blocks in states.items():
        writer.writerows({**({STATE: state} if named else {}), **row} for row in _rows(blocks))
    store.write_atomically(path, text.getvalue().encode())


def _rows(blocks: Sequence[Block]) -> list[dict[str, str]]:
    """Return the rows of one load state: cells by column."""
    rows: list[dict[str, str]] = []
    numbers: dict[str, str] = {}
    used: set[str] = set()
    for block in blocks:
        words = [word for field, _ in block for word in field.columns]
        start = len(rows) if used & set(words) else 0
        used.update(words)
        for field, array in block:
            if not np.ndim(array):
                numbers[field.columns[0]] = _cell(float(array))
                continue
            cells = np.asarray(array).reshape(-1, len(field.columns)).tolist()
            rows += [{} for _ in range(start + len(cells) - len(rows))]
            for row, values in zip(rows[start:], cells, strict=False):
                row.update(zip(field.columns, map(_cell, values), strict=True))
    return [*rows, numbers] if numbers else rows


def _cell(value: float) -> str:
    return "NA" if np.isnan(value) else repr(value)


def write_netcdf(path: str | Path, states: Mapping[str, Sequence[Block]]) -> None:
    """Write every array as a variable; arrays of one block share the dimension of their rows.

    In several load states, variables are called ``name@state``.
    """
    variables = {}
    blocks = [(state, block) for state, blocks in states.items() for block in blocks]
    for k, (state, block) in enumerate(blocks):
        for field, array in block:
            dims = [f"point_{k}", *(f"component_{n}" for n in np.shape(array)[1:])]
            variables[in_state(field.variable, state)] = (dims[: np.ndim(array)], np.asarray(array))
    store.write_netcdf(path, xr.Dataset(variables))
