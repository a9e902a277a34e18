"""A first guess of viscosity for the scene file of a specimen whose table has times."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from emulator.core.cells import Cells, without_unloading
from emulator.core.errors import InputError
from emulator.scenes.draft import prior_lines
from emulator.specimens.specimen import read_states
from emulator.specimens.states import States, falls
from emulator.specimens.tube import Tube
from emulator.viscosity.series import Viscosity
from emulator.viscosity.times import check_times, read_times, time_column

_RATES = 1.5  # ratio of the mean rates of two tests that are two
_DECADES = 1.5  # of times that a hold has for a second term


class ViscosityDraft(NamedTuple):
    """The viscosity that is proposed for a table.

    reasons : what the table shows, in words.
    lines : of the scene file.
    """

    viscosity: Viscosity
    reasons: tuple[str, ...]
    lines: tuple[str, ...]


def draft_viscosity(cells: Cells, tube: Tube | None) -> tuple[Cells, ViscosityDraft | str]:
    """Return the rows of a table that are data, and the viscosity proposed for it.

    In its place a text says why there is none; it is empty for a table without times.

    cells : all rows, those of unloading included.
    """
    if time_column(cells) is None:
        return without_unloading(cells), ""
    try:
        times = read_times(cells)
        states = read_states(cells, tube, timed=True)
        size = 1 if tube is None else tube.size
        tests = {name: rows[::size] // size for name, rows in states.protocols.items()}
        check_times(times, tests, len(times))
    except InputError as error:
        return without_unloading(cells), f"no [viscosity], its times cannot be read: {error}"
    reasons = tuple(_reasons(states, times, tests, size, list(cells.rows)))
    if not reasons:
        text = "no hold, no return and one rate, so that the table does not tell how it relaxes"
        return without_unloading(cells), f"no [viscosity]: {text}"
    steps = np.concatenate([np.diff(times[rows]) for rows in tests.values()])
    fast = float(np.median(steps[steps > 0.0]))
    slow = max(float(np.ptp(times[rows])) for rows in tests.values())
    held = any("hold" in reason for reason in reasons)
    viscosity = Viscosity(terms=2 if held and slow > 10.0**_DECADES * fast else 1)
    lines = tuple(_lines(viscosity, fast, slow))
    return cells, ViscosityDraft(viscosity, reasons, lines)


def _reasons(
    states: States, times: np.ndarray, tests: dict[str, np.ndarray], size: int, numbers: list[int]
) -> Iterator[str]:
    """Say which holds, returns and rates a table has; ``numbers`` are its rows in the file."""
    for run in states.holds():
        rows = run[::size] // size
        if (length := float(np.ptp(times[rows]))) > 0.0:
            first, last = numbers[rows[0]], numbers[rows[-1]]
            yield f"rows {first} to {last} are a hold of {length:.4g} s"
    rates = {}
    for name, rows in tests.items():
        of = states.gradients[rows * size], states.pulls[rows * size]
        ways = [np.linalg.norm(part.reshape(len(rows), -1), axis=1) for part in of]
        title = f"test '{name}'" if name else "the test"
        if any(falls(way).any() for way in ways):
            yield f"{title} goes back"
        way = max(ways, key=np.max)
        ramp = np.argmax(way >= 0.99 * way.max())
        if ramp and times[rows[ramp]] > times[rows[0]]:
            rates[title] = (way[ramp] - way[0]) / (times[rows[ramp]] - times[rows[0]])
    if rates and max(rates.values()) > _RATES * min(rates.values()):
        slow, fast = min(rates, key=rates.__getitem__), max(rates, key=rates.__getitem__)
        yield f"{fast} is {rates[fast] / rates[slow]:.3g} times as fast as {slow}"


def _lines(viscosity: Viscosity, fast: float, slow: float) -> Iterator[str]:
    """Yield the tables of the scene file: times that the table shows, in equal ratios."""
    yield from ("", "[viscosity]   # CHANGE: or leave it out, for an elastic tissue")
    yield from (f'kind = "{viscosity.kind}"   # or "spectrum"', f"terms = {viscosity.count}")
    log_sd = 0.5 * np.log(slow / fast) / viscosity.count
    for k in range(1, viscosity.count + 1):
        yield from ("", f"[parameters.relaxation_{k}]")
        yield "range = [0.01, 0.99]   # CHANGE: fraction of the stress that relaxes with tau"
        median = fast * (slow / fast) ** ((k - 0.5) / viscosity.count)
        source = f"a guess, between the rows' {fast:.2g} s and the test's {slow:.3g} s"
        comment = "   # CHANGE: a guess"
        yield from ("", f"[parameters.tau_{k}]", 'unit = "s"')
        yield from prior_lines(median, round(max(log_sd, 0.5), 2), source, comment)
