"""First files of an external problem, from a table of runs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError
from emulator.core.units import with_unit
from emulator.external.tables import RunTable, read_runs

_LOG = 10.0  # ratio of the ends of a range from which its scale may be logarithmic


class TableDraft(NamedTuple):
    """The file that was written, the names of parameters and outputs, and notes on both."""

    path: Path
    parameters: list[str]
    outputs: list[str]
    notes: list[str]


def draft_of_table(table: Path, out: Path, inputs: Sequence[str]) -> TableDraft:
    """Write the file of a problem that is a table of runs.

    Parameters
    ----------
    table : the table; a row a run.
    out : the file to write.
    inputs : the columns of parameters, or the number of the first columns that are; all other
        columns of numbers are outputs.

    Raises
    ------
    InputError
        No such column, no output, or the file is there already.
    """
    if out.exists():
        raise InputError(f"{out} is there already; give another name with --out")
    runs = read_runs(table)
    chosen = _chosen(runs, inputs)
    notes, parameters, outputs, columns = list[str](), list[str](), list[str](), dict[str, str]()
    blocks = []
    for word in chosen:
        values = runs.column(word)
        if values.shape[1] > 1:
            raise InputError(f"{table}: parameter '{word}' has {values.shape[1]} numbers a row")
        name = _named(word, columns)
        low, high = float(values.min()), float(values.max())
        if low == high:
            notes.append(f"'{word}' is {low:g} in all rows: left out")
            del columns[name]
            continue
        scale = 'scale = "log"\n' if _is_log(values) else ""
        blocks.append(
            f"[parameters.{name}]\n{_unit_line(runs, word)}range = [{low:.10g}, {high:.10g}]"
            f"  # of the rows: the map answers nowhere else\n{scale}"
        )
        parameters.append(name)
    for word in (w for w in runs.sizes if w not in chosen):
        try:
            values = runs.column(word, gaps=True)
        except InputError:
            notes.append(f"'{word}' has text: left out")
            continue
        name = _named(word, columns)
        if not np.isfinite(values).any():
            notes.append(f"'{word}' is empty: left out")
            del columns[name]
            continue
        size = f"size = {values.shape[1]}\n" if values.shape[1] > 1 else ""
        blocks.append(f"[outputs.{name}]\n{_unit_line(runs, word)}{size}")
        outputs.append(name)
    if not parameters or not outputs:
        raise InputError(f"{table}: no {'outputs' if parameters else 'parameters'}; see --inputs")
    renamed = {name: word for name, word in columns.items() if name != word}
    notes += [f"column '{word}' is called {name}" for name, word in list(renamed.items())[:5]]
    out.write_text("\n".join([_head(table, renamed), *blocks]), encoding="utf-8")
    return TableDraft(out, parameters, outputs, notes)


def _head(table: Path, renamed: Mapping[str, str]) -> str:
    """Return the first lines of the file; ``renamed`` has columns by their names in it."""
    entries = ", ".join(f"{name} = {json.dumps(word)}" for name, word in renamed.items())
    return (
        "# A table of runs as a problem: calibrate infer FILE --data DATA.csv --noise OUTPUT=SD\n"
        f'[solver]\nkind = "table"\nfile = {json.dumps(table.name)}\n'
    ) + (f"columns = {{ {entries} }}\n" if renamed else "")


def _chosen(runs: RunTable, inputs: Sequence[str]) -> list[str]:
    words = list(runs.sizes)
    if len(inputs) == 1 and inputs[0].isdigit() and inputs[0] not in words:
        count = int(inputs[0])
        if not 0 < count < len(words):
            raise InputError(f"--inputs {count}: {runs.path} has {len(words)} columns")
        if runs.path.is_dir():
            raise InputError(f"--inputs {count}: arrays of {runs.path} have no order; name them")
        return words[:count]
    for word in inputs:
        if word not in words:
            raise InputError(f"--inputs: {runs.path} has no column '{word}'")
    return list(inputs)


def _is_log(values: np.ndarray) -> bool:
    """Return whether values are spread over the logarithms of their range, by their median."""
    low, high = values.min(), values.max()
    if low <= 0.0 or high <= _LOG * low:
        return False
    middle = np.median(values)
    shares = np.log(middle / low) / np.log(high / low), (middle - low) / (high - low)
    return bool(abs(shares[0] - 0.5) < abs(shares[1] - 0.5))


def _named(word: str, columns: dict[str, str]) -> str:
    """Return a name for a column, of letters, digits and _, that no other has; and keep it."""
    name = re.sub(r"\W+", "_", with_unit(word)[0]).strip("_") or "column"
    name = f"_{name}" if name[0].isdigit() else name
    known, number = name, 2
    while name in columns:
        name, number = f"{known}_{number}", number + 1
    columns[name] = word
    return name


def _unit_line(runs: RunTable, word: str) -> str:
    unit = runs.units.get(word)
    return f"unit = {json.dumps(unit)}\n" if unit else ""
