"""Times of a table's rows, and what in a table shows that a tissue relaxes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from emulator.core.cells import Cells
from emulator.core.errors import InputError
from emulator.core.units import IN_S, factor, with_unit

TIME = "time"
"""The column of times, in s or the unit it says."""


def time_column(cells: Cells) -> str | None:
    """Return the column of times, or None."""
    return next((word for word in cells.words if with_unit(word)[0] == TIME), None)


def read_times(cells: Cells) -> np.ndarray:
    """Return the times (d,) of a table's rows in s.

    :class:`InputError` without a column of times, or for a time that is no number.
    """
    if (word := time_column(cells)) is None:
        raise InputError(
            f"data file {cells.path}: no column '{TIME}', which viscosity needs; it has "
            + ", ".join(filter(None, cells.words))
        )
    scale = factor(word, with_unit(word)[1], "s", IN_S)
    return scale * np.array([cells.number(row, word) for row in cells.rows])


def check_times(times: np.ndarray, tests: Mapping[str, np.ndarray], count: int) -> None:
    """Refuse times (d,) that are not finite, are below 0 or go back in a test.

    tests : the rows (k,) of each test.
    count : the number of measured states, d.
    """
    if times.shape != (count,):
        raise InputError(f"{times.size} times of {count} states; give each state its time")
    if (bad := np.flatnonzero(~np.isfinite(times) | (times < 0.0))).size:
        raise InputError(
            f"row {bad[0] + 1}: time is {times[bad[0]]:g} s; give 0 or more, counted from when the "
            "specimen was at rest"
        )
    for name, rows in tests.items():
        back = np.flatnonzero(np.diff(times[rows]) < 0.0)
        if len(back):
            row, before = rows[back[0] + 1], rows[back[0]]
            test = f" of '{name}'" if name else ""
            raise InputError(
                f"row {row + 1}{test}: time goes back from {times[before]:g} to {times[row]:g} s; "
                "rows of a test are in the order of time, another test has another name in a "
                "column 'protocol'"
            )
