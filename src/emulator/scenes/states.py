r"""Homogeneous states of specimens, from the columns of a table.

The machine prescribes some components of the displacement gradient,

.. math:: F = I + H, \qquad H = \partial u / \partial X ,

and across a free direction i nothing pulls, :math:`P_{ii} = 0`. Shears that a table does not
mention are zero.

========================  ====================================================
column                    is
========================  ====================================================
``stretch_x``             :math:`\lambda = F_{xx}`, 1 at rest
``strain_x``              :math:`\lambda - 1`
``green_x``               :math:`(\lambda^2 - 1)/2`
``shear_xy``              :math:`F_{xy}`, the amount of shear along x of planes normal to y
========================  ====================================================

Strains and shears may be in percent, ``strain_x [%]``. A direction without a value is free.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from emulator.core.cells import PROTOCOL
from emulator.core.errors import InputError

AXES = "xyz"
_MOTION = re.compile(r"(stretch|strain|green)_([xyz])|shear_([xyz])([xyz])")
_WITH_UNIT = re.compile(r"([^\[(]*[^\[( ]) *(?:[\[(] *([^\])]*?) *[\])])?")
STRETCHES = (0.2, 5.0)
"""Smallest and largest stretch that a table may have."""
_MOST_SHEAR = 3.0
_ROUND_OFF = 1e-9


class States(NamedTuple):
    """Homogeneous states of a specimen.

    gradients : the prescribed H = F - I, (m, 3, 3); zero in free directions.
    free : whether the stretch along each axis is free, (m, 3).
    protocols : the rows (k,) of each test, by its name.
    """

    gradients: np.ndarray
    free: np.ndarray
    protocols: Mapping[str, np.ndarray]

    @property
    def paths(self) -> np.ndarray:
        """The way (m,) of each state from the first of its test, in stretch."""
        found = np.zeros(len(self.gradients))
        for rows in self.protocols.values():
            steps = np.linalg.norm(np.diff(self.gradients[rows], axis=0), axis=(1, 2))
            found[rows[1:]] = np.cumsum(steps)
        return found


def with_unit(word: str) -> tuple[str, str]:
    """Return the name and the unit of a column such as ``stress_x [kPa]``; no unit is empty."""
    found = _WITH_UNIT.fullmatch(word.strip())
    return (found[1], found[2] or "") if found else (word, "")


def motion_columns(words: Collection[str]) -> list[str]:
    """Return the columns that say how a specimen moves."""
    return [word for word in words if _MOTION.fullmatch(with_unit(word)[0])]


def states(
    columns: Mapping[str, np.ndarray],
    protocols: Sequence[str] | None = None,
    *,
    ordered: bool = True,
) -> States:
    """Return the states that columns (m,) of a table describe, NaN where a direction is free.

    Parameters
    ----------
    protocols : the name of each row's test; by default all rows are of one.
    ordered : whether the rows of a test lead away from rest, with the same directions free.

    Raises
    ------
    InputError
        No column or two of one component, a unit that is no percent, a stretch that is none, a
        state in which nothing or everything is free, or a test that goes back.
    """
    if not columns:
        raise InputError("no column says how the specimen moves: stretch_x, strain_x or shear_xy")
    count = len(next(iter(columns.values())))
    H = np.full((count, 3, 3), 0.0)
    H[:, range(3), range(3)] = np.nan
    sources: dict[tuple[int, int], str] = {}
    for word, values in columns.items():
        name, unit = with_unit(word)
        found = _MOTION.fullmatch(name)
        assert found is not None
        measure, axis, *plane = found.groups()
        place = tuple(AXES.index(a) for a in (plane if axis is None else (axis, axis)))
        if place in sources or (axis is None and place[0] == place[1]):
            other = sources.get((place[0], place[1]), "a stretch")
            raise InputError(f"column '{word}' says the same as '{other}'; leave one out")
        sources[place[0], place[1]] = word
        H[:, place[0], place[1]] = _component(word, measure, unit, np.asarray(values, dtype=float))
    free = np.isnan(H[:, range(3), range(3)])
    gradients = np.where(np.isnan(H), 0.0, H)
    _check(gradients, free, sources)
    tests = rows_of([""] * count if protocols is None else protocols)
    for name, own in tests.items() if ordered else ():
        _check_path(gradients[own], free[own], own, name)
    return States(gradients, free, tests)


def rows_of(names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the rows (k,) of each test, from the test of each row."""
    return {n: np.flatnonzero([n == name for name in names]) for n in dict.fromkeys(names)}


def _component(word: str, measure: str | None, unit: str, values: np.ndarray) -> np.ndarray:
    """Return the component of H that a column gives, NaN where it is free."""
    if unit not in ("", "1", "-", "%", "mm/mm") or (unit == "%" and measure == "stretch"):
        raise InputError(f"column '{word}': unit '{unit}'; a stretch has none, a strain none or %")
    values = 0.01 * values if unit == "%" else values
    if measure is None:
        return np.where(np.isnan(values), 0.0, values)
    if measure == "green":
        if (values <= -0.5).any():
            raise InputError(f"column '{word}' goes down to {np.nanmin(values):g}; above -0.5")
        return np.sqrt(1.0 + 2.0 * values) - 1.0
    return values - 1.0 if measure == "stretch" else values


def _check(H: np.ndarray, free: np.ndarray, sources: Mapping[tuple[int, int], str]) -> None:
    """Refuse states that no specimen has."""
    for (i, j), word in sources.items():
        value, held = H[:, i, j] + (i == j), ~free[:, i] | (i != j)
        low, high = STRETCHES if i == j else (-_MOST_SHEAR, _MOST_SHEAR)
        bad = np.flatnonzero(((value < low) | (value > high)) & held)
        if len(bad):
            hint = f"is it in percent? call it '{with_unit(word)[0]} [%]'"
            if "stretch" in word:
                hint = "a stretch is 1 at rest; a strain goes in strain_x, in percent strain_x [%]"
            kind = "stretch" if i == j else "shear"
            raise InputError(
                f"row {bad[0] + 1}, column '{word}' is a {kind} of {value[bad[0]]:g}, outside "
                f"{low:g} to {high:g}: {hint}"
            )
    sheared = (np.abs(H) * (1.0 - np.eye(3))).any(axis=(1, 2))
    loose = np.flatnonzero(free.all(axis=1) & ~sheared)
    if len(loose):
        raise InputError(f"row {loose[0] + 1} has no stretch and no shear; give one, or drop it")
    J = np.linalg.det(np.eye(3) + H)
    closed = np.flatnonzero(~free.any(axis=1) & (J <= 0.0))
    if len(closed):
        raise InputError(f"row {closed[0] + 1} turns the specimen inside out")


def _check_path(H: np.ndarray, free: np.ndarray, rows: np.ndarray, name: str) -> None:
    """Refuse a test in which a stretch is missing in some rows.

    Or one that goes back: unloading, or a second test under the same name.
    """
    test = f" of '{name}'" if name else ""
    for axis, own in zip(AXES, free.T, strict=True):
        if own.any() and not own.all():
            raise InputError(
                f"row {rows[np.argmax(own)] + 1}{test} has no stretch along {axis}, others have: "
                "give it, leave the row out, or name another test in a column 'protocol'"
            )
    away = np.linalg.norm(np.where(free[:, :, None] & np.eye(3, dtype=bool), 0.0, H), axis=(1, 2))
    back = np.flatnonzero(np.diff(away) < -_ROUND_OFF)
    if len(back):
        raise InputError(
            f"row {rows[back[0] + 1] + 1}{test} is nearer to rest than the one before: unloading "
            "goes under 'unloading' in a column 'branch', another test under another name in a "
            f"column '{PROTOCOL}'"
        )
