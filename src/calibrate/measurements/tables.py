"""Data files as named arrays: CSV in its dialects, and netCDF.

A CSV file has one header line, and columns separated by commas, semicolons or tabs, whichever the
header has; with the latter two, numbers may have decimal commas. Blanks around words, empty lines
and lines that begin with ``#`` are ignored. A measured value that is missing is an empty cell,
``NA`` or ``nan``, and NaN in netCDF; nodes and positions may not be missing. A column ``state``
names the load state of each row; in netCDF, variables are called ``name@state``. A column or
variable ``known:NAME`` is a parameter's value in a state; rows of a CSV file with such columns
and neither ``state`` nor places are a load state each.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from pathlib import Path

import numpy as np
import xarray as xr

from calibrate.measurements.observation import Block, Field
from calibrate.state_names import in_state, split, states_of
from emulator.core import store
from emulator.core.errors import InputError

STATE = "state"
"""Column of a CSV file that names the load state of a row."""

KNOWN = "known:"
"""Before a parameter's name: a column of its value, where that is known."""

_PLACES = {"node", "x", "segment"}  # columns of tables whose rows are places, not load states
_TEXT = (".csv", ".tsv", ".txt")
_SPREADSHEETS = (".xlsx", ".xls", ".ods")
_MISSING = ("", "na", "n/a", "nan")


class CSVTable:
    """Columns of a CSV file, of all its load states or of one.

    words : the names of the columns.
    what : the word for one of them, for errors.
    rows : the text of each cell by column, by the row's number, from 1 after the header.
    """

    what = "column"

    def __init__(self, path: Path) -> None:
        self.path, lines = path, _lines(path)
        delimiter = _delimiter(lines[0]) if lines else ","
        self.decimal_comma = delimiter != ","
        try:
            table = csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter, strict=True)
            header, *cells = [[cell.strip() for cell in row] for row in table] or [[]]
        except csv.Error as error:
            raise InputError(f"data file {path} is not a CSV file: {error}") from error
        self.words: Sequence[str] = header
        self._check_header(lines)
        filled = {k: row for k, row in enumerate(cells, 1) if any(row) or len(row) > 1}
        self.rows = {k: self._row(k, row) for k, row in filled.items()}
        if self.words and not self.rows:
            raise InputError(f"data file {path}: names of columns, and no row below them")

    def _check_header(self, lines: Sequence[str]) -> None:
        if self.words and all(map(_is_number, self.words)):
            raise InputError(
                f"data file {self.path}: its first line, '{lines[0].strip()[:40]}', has no names "
                "of columns; put them above it, e.g. node,ux,uy,uz"
            )
        for word in self.words:
            if word and self.words.count(word) > 1:
                raise InputError(f"data file {self.path}: column '{word}' is there twice")

    def _row(self, number: int, cells: list[str]) -> dict[str, str]:
        if any(cells[len(self.words) :]):
            hint = "" if self.decimal_comma else "; decimal commas need semicolons between columns"
            raise InputError(
                f"data file {self.path}: row {number} has {len(cells)} values for "
                f"{len(self.words)} columns{hint}"
            )
        padded = cells + [""] * (len(self.words) - len(cells))
        return dict(zip(self.words, padded, strict=False))

    def states(self) -> dict[str, CSVTable]:
        """Return the table of each load state, by the column ``state`` or a loading curve's rows.

        One empty name where the file names no state.
        """
        known = any(word.startswith(KNOWN) for word in self.words)
        curve = STATE not in self.words and known and not _PLACES & set(self.words)
        if STATE not in self.words and not curve:
            return {"": self}
        tables: dict[str, CSVTable] = {}
        for number, row in self.rows.items():
            state = str(number) if curve else row[STATE]
            if not state or "@" in state or "/" in state:
                raise InputError(
                    f"data file {self.path}: row {number}, column '{STATE}' is '{state}'; "
                    "give every row the name of its load state, without @ and /"
                )
            if state not in tables:
                tables[state] = copy(self)
                tables[state].rows = {}
            tables[state].rows[number] = row
        for table in tables.values():
            # A column that is empty in a state was not measured there.
            table.words = [
                w for w in self.words if w != STATE and any(row[w] for row in table.rows.values())
            ]
        return tables

    def known(self) -> dict[str, float]:
        """Return the parameters that are known in this load state, from columns ``known:NAME``.

        Raises
        ------
        InputError
            A value that is no number, or several that differ.
        """
        values: dict[str, float] = {}
        for word in (w for w in self.words if w.startswith(KNOWN)):
            name, field = word.removeprefix(KNOWN), Field(word, (word,), where=True)
            for number, row in self.rows.items():
                value = self._number(number, row, word, field) if row[word] else None
                if value is not None and values.setdefault(name, value) != value:
                    raise InputError(
                        f"data file {self.path}: row {number}, column '{word}' is {value}, and "
                        f"{values[name]} before it in the same load state"
                    )
        return values

    def words_of(self, field: Field) -> tuple[str, ...]:
        """Return the words that hold ``field`` in a file of this format."""
        return field.columns

    def arrays(
        self, fields: Sequence[Field], others: Collection[str] = ()
    ) -> dict[str, np.ndarray]:
        """Return arrays of numbers by variable, NaN where a measured value is missing.

        Parameters
        ----------
        fields : the fields of an observation; the file has every word of theirs.
        others : columns of what other observations measured at the same places; a row without
            measured values of ``fields`` that has values there is theirs.
        """
        measured = [word for field in fields if not field.where for word in field.columns]
        places = [word for field in fields if field.where for word in field.columns]
        rows = {
            k: row
            for k, row in self.rows.items()
            if any(row[w] for w in measured)
            or (any(row[w] for w in places) and not any(row[w] for w in others))
        }
        arrays = {}
        for field in fields:
            numbers = [
                [self._number(k, row, w, field) for w in field.columns] for k, row in rows.items()
            ]
            array = np.array(numbers, dtype=float).reshape(len(rows), len(field.columns))
            arrays[field.variable] = array[:, 0] if len(field.columns) == 1 else array
        return arrays

    def _number(self, number: int, row: Mapping[str, str], word: str, field: Field) -> float:
        text = row[word]
        if not field.where and text.lower() in _MISSING:
            return np.nan
        if self.decimal_comma and "." not in text:
            text = text.replace(",", ".")
        try:
            return float(text)
        except ValueError as error:
            fault = f"'{row[word]}', not a number" if row[word] else "empty"
            raise InputError(
                f"data file {self.path}: row {number}, column '{word}' is {fault}"
            ) from error


def _is_number(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return False
    return True


def _lines(path: Path) -> list[str]:
    """Return the lines that are neither empty nor comments, the header first."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"data file {path} is not UTF-8 text; save it as CSV UTF-8") from error
    if "\0" in text:
        raise InputError(f"data file {path} is not a CSV file: it holds bytes that are no text")
    lines = [line.strip(" \r") for line in text.split("\n")]
    return [line for line in lines if line.strip() and not line.startswith("#")]


def _delimiter(header: str) -> str:
    """Return the separator of the header's words; quoted text does not count."""
    bare = re.sub(r'"[^"]*"', "", header)
    return next((mark for mark in ";\t" if mark in bare), ",")


class NetCDFTable:
    """Variables and coordinates of a netCDF file, with the methods of :class:`CSVTable`.

    data : the dataset.
    state : the load state whose variables these are, or an empty word.
    """

    what = "variable"

    def __init__(self, path: Path) -> None:
        try:
            with xr.open_dataset(path, engine="h5netcdf") as file:
                self.data = file.load()
        except (OSError, ValueError, KeyError) as error:
            raise InputError(
                f"data file {path} is neither CSV ({', '.join(_TEXT)}) nor readable netCDF"
            ) from error
        self.path, self.state = path, ""
        self.words: Sequence[str] = list(map(str, self.data.variables))

    def states(self) -> dict[str, NetCDFTable]:
        """Return the variables of each state, by what follows ``@`` in their names."""
        tables: dict[str, NetCDFTable] = {}
        # Coordinates without values of their own belong to no state.
        own = [w for w in self.words if w not in self.data.dims]
        for state in states_of(own, f"data file {self.path}"):
            table = tables[state] = copy(self)
            table.state = state
            table.words = [base for base, word_state in map(split, own) if word_state == state]
        return tables

    def known(self) -> dict[str, float]:
        """Return the numbers in the variables ``known:NAME``."""
        words = [word for word in self.words if word.startswith(KNOWN)]
        arrays = self.arrays([Field(word, (word,), where=True) for word in words])
        for word, array in arrays.items():
            if np.shape(array) != ():
                raise InputError(f"data file {self.path}: variable '{word}' is not a number")
        return {word.removeprefix(KNOWN): float(array) for word, array in arrays.items()}

    def words_of(self, field: Field) -> tuple[str, ...]:
        """Return the field's variable."""
        return (field.variable,)

    def arrays(
        self, fields: Sequence[Field], others: Collection[str] = ()
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


DataTable = CSVTable | NetCDFTable
"""Named arrays of a file."""


def open_data(path: Path) -> DataTable:
    """Read the file at ``path``: CSV by its suffix, else netCDF; :class:`InputError` for others."""
    if not path.is_file():
        raise InputError(f"data file {path} does not exist")
    if path.suffix.lower() in _SPREADSHEETS:
        raise InputError(f"data file {path} is a spreadsheet; save it as CSV")
    return CSVTable(path) if path.suffix.lower() in _TEXT else NetCDFTable(path)


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
