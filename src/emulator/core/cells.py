"""Tables as text cells: CSV in its dialects, and the sheets of a spreadsheet.

A CSV file has one header line, and columns separated by commas, semicolons or tabs, whichever the
header has; with the latter two, numbers may have decimal commas. Blanks around words, empty lines
and lines that begin with ``#`` are ignored. In a spreadsheet (an extra, ``openpyxl``) the first row
of a sheet is its header, and several sheets become one table with a column ``protocol``.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from emulator.core.errors import InputError
from emulator.core.units import UNITS, with_unit

TEXT = (".csv", ".tsv", ".txt")
SPREADSHEETS = (".xlsx", ".xlsm")
OTHER_SPREADSHEETS = (".xls", ".ods")
"""Endings of spreadsheets that are not read."""
PROTOCOL, BRANCH = "protocol", "branch"
"""Columns of the test that a row belongs to, and of whether it was loading."""
LOADING, UNLOADING = "loading", "unloading"
"""The words in the column ``branch`` of rows that are data, and of those that are left out."""
_DIMENSIONLESS = ("-", "1", "mm/mm")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}([., ']\d{3})+([.,]\d*)?")
_MARKED = re.compile(r"[-+]?\d+([.,])\d+")
MISSING = ("", "na", "n/a", "nan", "#n/a", "-", "--")


class Cells(NamedTuple):
    """A table as text.

    path : the file.
    words : the names of the columns.
    rows : the text of each cell by column, by the row's number, from 1 after the header.
    decimal_comma : whether numbers may have decimal commas.
    unloading : the number of rows of unloading, which are left out.
    """

    path: Path
    words: Sequence[str]
    rows: Mapping[int, Mapping[str, str]]
    decimal_comma: bool
    unloading: int = 0

    def number(self, row: int, word: str, *, gaps: bool = False) -> float:
        """Return the number in a row and column; NaN where it is missing and may be.

        :class:`InputError` for text, and for an empty cell that may not be.
        """
        cell = self.rows[row][word]
        if gaps and cell.lower() in MISSING:
            return float("nan")
        try:
            if "_" in cell:  # Python reads 5_7 as 57
                raise ValueError
            return float(cell.replace(",", ".") if self.decimal_comma and "." not in cell else cell)
        except ValueError as error:
            fault = f"'{cell}', not a number" if cell else "empty"
            if _THOUSANDS.fullmatch(cell):
                fault += ": leave out marks of thousands"
            raise InputError(
                f"data file {self.path}: row {row}, column '{word}' is {fault}"
            ) from error


def read_cells(path: Path, *, unloading: bool = False) -> Cells:
    """Return the table of a CSV file or a spreadsheet.

    unloading : whether rows of unloading are data; else they are left out.

    Raises
    ------
    InputError
        A file that is none, two columns of one name, a row longer than the header, or no rows.
    """
    if path.suffix.lower() in OTHER_SPREADSHEETS:
        raise InputError(f"data file {path} is a spreadsheet; save it as CSV")
    sheets = path.suffix.lower() in SPREADSHEETS
    words, cells, decimal_comma = (_of_sheets if sheets else _of_text)(path)
    if words and all(map(_is_number, words)):
        first = (";" if decimal_comma else ",").join(words)[:40]
        raise InputError(
            f"data file {path}: its first line, '{first}', has no names "
            "of columns; put them above it, e.g. node,ux,uy,uz"
        )
    while words and not words[-1] and not any("".join(row[len(words) - 1 :]) for row in cells):
        words = words[:-1]  # as spreadsheets export them
    while cells and not any(cells[-1]):
        cells = cells[:-1]
    for word in words:
        if word and words.count(word) > 1:
            raise InputError(f"data file {path}: column '{word}' is there twice")
    rows: dict[int, dict[str, str]] = {}
    names, units = words, _units_of(words, cells[0]) if cells else None
    if units is not None:
        words = [f"{w} [{unit}]" if unit else w for w, unit in zip(words, units, strict=True)]
    for number, row in enumerate(cells, 1):
        if row[: len(names)] == names:
            raise InputError(
                f"data file {path}: row {number} has the names of columns again: give one table, "
                f"in which a column '{PROTOCOL}' names each row's test"
            )
        if any(row[len(words) :]):
            hint = "" if decimal_comma else "; decimal commas need semicolons between columns"
            raise InputError(
                f"data file {path}: row {number} has {len(row)} values for {len(words)} "
                f"columns{hint}"
            )
        if any(row) and (number > 1 or units is None):
            padded = row + [""] * (len(words) - len(row))
            rows[number] = dict(zip(words, padded, strict=False))
    if words and not rows:
        raise InputError(f"data file {path}: names of columns, and no row below them")
    _check_marks(path, rows, decimal_comma=decimal_comma)
    table = Cells(path, words, rows, decimal_comma)
    return table if unloading else without_unloading(table)


def without_unloading(cells: Cells) -> Cells:
    """Return a table without its rows of unloading; :class:`InputError` if none is left."""
    if BRANCH not in cells.words:
        return cells
    rows = {k: row for k, row in cells.rows.items() if row[BRANCH].lower() != UNLOADING}
    if not rows:
        raise InputError(
            f"data file {cells.path}: each row is unloading, so that none is left; read a test "
            f"that was recorded while it unloads from its end: reverse its rows, without '{BRANCH}'"
        )
    return cells._replace(rows=rows, unloading=len(cells.rows) - len(rows))


def _units_of(words: Sequence[str], row: Sequence[str]) -> list[str] | None:
    """Return the unit of each column if the first row has units in place of numbers, else None."""
    bare = [cell.strip("[]()") for cell in row[: len(words)]]
    known = [text in UNITS or text != cell for cell, text in zip(row, bare, strict=False)]
    if len(bare) < len(words) or not all(known) or any(map(_is_number, bare)) or not any(bare):
        return None
    if any(with_unit(word)[1] for word in words):
        return None
    return ["" if text in _DIMENSIONLESS else text for text in bare]


def _check_marks(path: Path, rows: Mapping[int, Mapping[str, str]], *, decimal_comma: bool) -> None:
    """Raise InputError where some numbers have a comma and others a point: one may be thousands."""
    if not decimal_comma:
        return
    first: dict[str, tuple[int, str, str]] = {}
    for number, row in rows.items():
        for word, cell in row.items():
            if (mark := _MARKED.fullmatch(cell)) is not None:
                first.setdefault(mark[1], (number, word, cell))
    if len(first) == 2:
        (a, in_a, one), (b, in_b, other) = first.values()
        raise InputError(
            f"data file {path}: row {a}, column '{in_a}' is '{one}' and row {b}, column '{in_b}' "
            f"is '{other}': write all decimals with a comma, or all with a point"
        )


_HEAD = 100  # lines at most before the columns of another program's file
_OF_PROGRAMS = (
    (
        re.compile("COORDINATE_X.*DISPLACEMENT_X"),
        "a frame of DICe, in pixels with y down: write its points as point,x,y and those of all "
        "frames as frame,point,ux,uy, in mm with y up, without those whose SIGMA is -1",
    ),
    (
        re.compile(r"\A\*(Step|Title|Time)\s*="),
        "a log of FEBio: write its lines below *Data as a table with names of columns, a frame or "
        "a state in each row",
    ),
)
"""Files of other programs by what their first lines have, and how to make a table of them."""

Raw = tuple[list[str], list[list[str]], bool]
"""Header, rows of cells, and whether numbers may have decimal commas."""


def _of_text(path: Path) -> Raw:
    lines = _lines(path)
    head = "\n".join(lines[:_HEAD])
    for form, remedy in _OF_PROGRAMS:
        if form.search(head):
            raise InputError(f"data file {path} is {remedy}")
    header = re.sub(r'"[^"]*"', "", lines[0]) if lines else ""  # quoted text does not count
    delimiter = next((mark for mark in ";\t" if mark in header), ",")
    try:
        table = csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter, strict=True)
        words, *cells = [[cell.strip() for cell in row] for row in table] or [[]]
    except csv.Error as error:
        raise InputError(f"data file {path} is not a CSV file: {error}") from error
    if cells and len(words) == 1 and all(len(row[0].split()) > 1 for row in (words, *cells)):
        raise InputError(
            f"data file {path}: its columns, '{words[0][:40]}', are separated by blanks: put "
            "commas, semicolons or tabs between them"
        )
    return words, cells, delimiter != ","


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


def _of_sheets(path: Path) -> Raw:
    try:
        from openpyxl import load_workbook
    except ImportError as error:
        raise InputError(
            f"data file {path} is a spreadsheet: save it as CSV, or install openpyxl "
            "(soft-tissue-calibrate[sheets])"
        ) from error
    try:
        book = load_workbook(path, read_only=True, data_only=True)
        sheets = {sheet.title: list(_texts(sheet.iter_rows(values_only=True))) for sheet in book}
    except Exception as error:  # openpyxl raises what its parsers do
        raise InputError(f"data file {path} is not a readable spreadsheet: {error}") from error
    sheets = {title: rows for title, rows in sheets.items() if len(rows) > 1}
    words = list(dict.fromkeys(word for rows in sheets.values() for word in rows[0] if word))
    several_sheets = len(sheets) > 1 and PROTOCOL not in words
    cells = []
    for title, (header, *rows) in sheets.items():
        for row in rows:
            by_word = dict(zip(header, row, strict=False))
            cells.append([by_word.get(word, "") for word in words] + [title] * several_sheets)
    return words + [PROTOCOL] * several_sheets, cells, False


def _texts(rows: Iterator[tuple[Any, ...]]) -> Iterator[list[str]]:
    """Yield the cells of each row that is not empty, as text."""
    for row in rows:
        texts = ["" if cell is None else str(cell).strip() for cell in row]
        if any(texts):
            yield texts


def _is_number(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return False
    return True
