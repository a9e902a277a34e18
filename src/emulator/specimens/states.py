r"""Homogeneous states of specimens, from the columns of a table.

The machine prescribes some components of the displacement gradient,

.. math:: F = I + H, \qquad H = \partial u / \partial X ,

and along a free direction i it pulls with a given first Piola-Kirchhoff stress, or with none,
:math:`P_{ii} = 0`. Shears that a table does not mention are zero.

========================  ====================================================
column                    is
========================  ====================================================
``stretch_x``             :math:`\lambda = F_{xx}`, 1 at rest
``strain_x``              :math:`\lambda - 1`
``green_x``               :math:`(\lambda^2 - 1)/2`
``shear_xy``              :math:`F_{xy}`, the amount of shear along x of planes normal to y
``applied_x``              :math:`P_{xx}` in kPa or another unit, which the machine pulls with
========================  ====================================================

Strains and shears may be in percent, ``strain_x [%]``. A direction without a value is free, and so
is one with ``applied_x``, whose stretch is then a measurement.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from emulator.core.cells import BRANCH, PROTOCOL, UNLOADING
from emulator.core.errors import InputError
from emulator.core.units import IN_KPA, factor, with_unit

AXES = "xyz"
APPLIED = "applied"
_MOTION = re.compile(rf"(stretch|strain|green|{APPLIED})_([xyz])|shear_([xyz])([xyz])")
STRETCHES = (0.1, 12.0)
"""Smallest and largest stretch that a table may have; elastomers reach 10."""
_MOST_SHEAR = 5.0
_UNDOUBTED = 1.0  # strain or shear above which a column has to say that it is not in percent
_BACK = 0.02  # share of a test's largest motion or pull by which measured ones may go back
_MOST_NOISE = 0.1  # share of the largest above which scatter is no noise but cycles
_NOISE = 2.2  # times what the largest and the smallest of as many rows of noise differ by
_STILL, _FEWEST_HELD = 0.002, 3  # share of the largest motion, and rows, of a hold
_FEWEST_NOISY = 8  # rows of a test that show its noise
_DIFFERENCES = ((2, 6.0), (4, 70.0))  # orders, and their variance over that of noise
_MEDIAN = 0.6745  # of the size of a normal number, over its sd
_JUMP = 0.1  # share of the largest by which the first row of another test is nearer to rest


class States(NamedTuple):
    """Homogeneous states of a specimen.

    gradients : the prescribed H = F - I, (m, 3, 3); zero in free directions.
    free : whether the stretch along each axis is free, (m, 3).
    pulls : the first Piola-Kirchhoff stress along each axis in kPa, (m, 3); zero where nothing
        pulls, or a stretch is prescribed.
    protocols : the rows (k,) of each test, by its name.
    """

    gradients: np.ndarray
    free: np.ndarray
    pulls: np.ndarray
    protocols: Mapping[str, np.ndarray]

    @property
    def paths(self) -> np.ndarray:
        """The arc length (m,) of each state from the first of its test.

        It is measured in prescribed stretch, plus the pull's way as a share of the test's largest
        pull. Neither depends on measurements.
        """
        lengths = np.zeros(len(self.gradients))
        for rows in self.protocols.values():
            steps = np.linalg.norm(np.diff(self.gradients[rows], axis=0), axis=(1, 2))
            largest = np.linalg.norm(self.pulls[rows], axis=1).max() or 1.0
            steps += np.linalg.norm(np.diff(self.pulls[rows], axis=0), axis=1) / largest
            lengths[rows[1:]] = np.cumsum(steps)
        return lengths

    def holds(self) -> list[np.ndarray]:
        """Return the rows (k,) of each state that a test stays in for some rows."""
        runs = []
        for rows in self.protocols.values():
            motion = np.hstack([self.gradients[rows].reshape(-1, 9), self.pulls[rows]])
            motion /= np.abs(motion).max(axis=0) + np.finfo(float).tiny
            usual = np.ptp(motion, axis=0).max() / len(rows)  # dense rows are all near
            still = min(_STILL, 0.5 * usual)
            start = 0
            for end in range(1, len(rows) + 1):
                if end < len(rows) and np.abs(motion[end] - motion[start]).max() <= still:
                    continue
                if end - start >= _FEWEST_HELD:
                    runs.append(rows[start:end])
                start = end
        return runs


def motion_columns(words: Collection[str]) -> list[str]:
    """Return the columns that say how a specimen moves, or how it is pulled."""
    return [word for word in words if _MOTION.fullmatch(with_unit(word)[0])]


def pull_columns(words: Collection[str]) -> dict[str, str]:
    """Return the column of the pull along each axis that has one."""
    return _along_axes(words, {APPLIED})


def stretch_columns(words: Collection[str]) -> dict[str, str]:
    """Return the column of the stretch along each axis that has one, in whichever measure."""
    return _along_axes(words, {"stretch", "strain", "green"})


def _along_axes(words: Collection[str], measures: Collection[str]) -> dict[str, str]:
    matches = {word: _MOTION.fullmatch(with_unit(word)[0]) for word in words}
    return {m[2]: word for word, m in matches.items() if m is not None and m[1] in measures}


def states(
    columns: Mapping[str, np.ndarray],
    protocols: Sequence[str] | None = None,
    *,
    ordered: bool = True,
    timed: bool = False,
) -> States:
    """Return the states that columns (m,) of a table describe, NaN where a direction is free.

    Parameters
    ----------
    protocols : the name of each row's test; by default all rows are of one.
    ordered : whether the rows of a test lead away from rest, with the same directions free.
    timed : whether they are in the order of time, so that they may go back.

    Raises
    ------
    InputError
        No column or two of one component, an unknown unit, a stretch that is none, a state that
        nothing moves or pulls, or a test that goes back.
    """
    H, pulls = components_of(columns)
    count, diagonal, pulled = len(H), np.eye(3, dtype=bool), ~np.isnan(pulls)
    free = np.isnan(H[:, range(3), range(3)]) | pulled
    sheared = [w for w in columns if with_unit(w)[0].startswith("shear_")]
    held = np.array([~np.isnan(columns[w]) for w in sheared]).any(axis=0) | np.zeros(count, bool)
    gradients = np.where(free[:, :, None] & diagonal, 0.0, H)
    _check(gradients, free, pulled, held)
    if protocols is not None and len(protocols) != count:
        raise InputError(f"{len(protocols)} names of tests for {count} states; give each its test")
    tests = rows_of([""] * count if protocols is None else protocols)
    for name, rows in tests.items() if ordered else ():
        _check_control(free[rows], pulls[rows], rows, name)
        if not timed:
            _check_path(gradients[rows], pulls[rows], rows, name)
    return States(gradients, free, np.nan_to_num(pulls), tests)


def components_of(columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return H (m, 3, 3) and the pulls (m, 3) in kPa that columns (m,) have, NaN without a value.

    The stretch along a pull is a measurement, and in H, too. Errors are those of :func:`states`.
    """
    if not columns:
        raise InputError("no column says how the specimen moves: stretch_x, strain_x or shear_xy")
    count = len(next(iter(columns.values())))
    H, pulls = np.zeros((count, 3, 3)), np.full((count, 3), np.nan)
    H[:, range(3), range(3)] = np.nan
    sources: dict[tuple[int, ...], str] = {}
    for word, values in columns.items():
        name, unit = with_unit(word)
        match = _MOTION.fullmatch(name)
        if match is None:
            raise InputError(
                f"column '{word}' says no motion; motions are stretch_x, strain_x, green_x, "
                f"shear_xy and {APPLIED}_x"
            )
        measure, axis, *plane = match.groups()
        numbers = np.asarray(values, dtype=float)
        if numbers.shape != (count,):
            raise InputError(
                f"column '{word}' has shape {numbers.shape}, the first one ({count},); give each "
                "a value a state"
            )
        letters = plane if axis is None else [axis] if measure == APPLIED else [axis, axis]
        place = tuple(AXES.index(a) for a in letters)
        if place in sources or (axis is None and place[0] == place[1]):
            other = sources.get(place, "a stretch")
            raise InputError(f"column '{word}' says the same as '{other}'; leave one out")
        sources[place] = word
        if measure == APPLIED:
            pulls[:, place[0]] = numbers * factor(word, unit, "kPa", IN_KPA)
            continue
        _check_unit(word, measure, unit, numbers)
        component = H[:, place[0], place[1]] = _component(word, measure, unit, numbers)
        kind, rest = ("shear", 0.0) if axis is None else ("stretch", 1.0)
        _check_component(word, rest + component, kind)
    if np.isinf(pulls).any():
        raise InputError(f"row {np.argmax(np.isinf(pulls).any(axis=1)) + 1} has an infinite pull")
    return H, pulls


def rows_of(names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the rows (k,) of each test, from the test of each row."""
    return {n: np.flatnonzero([n == name for name in names]) for n in dict.fromkeys(names)}


def _check_unit(word: str, measure: str | None, unit: str, values: np.ndarray) -> None:
    """Refuse strains and shears (m,) without a unit that may be in percent."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if unit == "" and measure != "stretch" and largest > _UNDOUBTED:
        raise InputError(
            f"column '{word}' reaches {largest:g} and has no unit: is it in percent? call it "
            f"'{word.strip()} [%]' if it is in percent, '{word.strip()} [-]' if it is not"
        )


def _component(word: str, measure: str | None, unit: str, values: np.ndarray) -> np.ndarray:
    """Return the component of H that a column gives, NaN where it is free."""
    if unit not in ("", "1", "-", "%", "mm/mm") or (unit == "%" and measure == "stretch"):
        hint = "; a shear is the tangent of its angle" if unit in ("deg", "°", "rad") else ""
        raise InputError(
            f"column '{word}': unit '{unit}'; a stretch has none, a strain none or %{hint}"
        )
    values = 0.01 * values if unit == "%" else values
    if measure is None:
        return np.where(np.isnan(values), 0.0, values)
    if measure == "green":
        if (values <= -0.5).any():
            raise InputError(f"column '{word}' goes down to {np.nanmin(values):g}; above -0.5")
        return np.sqrt(1.0 + 2.0 * values) - 1.0
    return values - 1.0 if measure == "stretch" else values


def _check_component(word: str, values: np.ndarray, kind: str) -> None:
    """Refuse stretches or shears (m,) that no specimen has; NaN passes."""
    low, high = STRETCHES if kind == "stretch" else (-_MOST_SHEAR, _MOST_SHEAR)
    bad = np.flatnonzero((values < low) | (values > high))
    if len(bad):
        hint = f"is it in percent? call it '{with_unit(word)[0]} [%]'"
        if "stretch" in word:
            hint = "a stretch is 1 at rest; a strain goes in strain_x, in percent strain_x [%]"
        raise InputError(
            f"row {bad[0] + 1}, column '{word}' is a {kind} of {values[bad[0]]:g}, outside "
            f"{low:g} to {high:g}: {hint}"
        )


def _check(H: np.ndarray, free: np.ndarray, pulled: np.ndarray, held: np.ndarray) -> None:
    """Refuse states that no specimen has; ``held`` (m,) says where a shear is given, if of 0."""
    loose = np.flatnonzero(free.all(axis=1) & ~held & ~pulled.any(axis=1))
    if len(loose):
        raise InputError(f"row {loose[0] + 1} has no stretch and no shear; give one, or drop it")
    J = np.linalg.det(np.eye(3) + H)
    closed = np.flatnonzero(~free.any(axis=1) & (J <= 0.0))
    if len(closed):
        raise InputError(f"row {closed[0] + 1} turns the specimen inside out")


def _check_control(free: np.ndarray, pulls: np.ndarray, rows: np.ndarray, name: str) -> None:
    """Refuse a test in which a stretch or a pull is missing in some rows."""
    test = f" of '{name}'" if name else ""
    for what, missing in (("pull", np.isnan(pulls)), ("stretch", free)):
        for axis, gaps in zip(AXES, missing.T, strict=True):
            if gaps.any() and not gaps.all():
                raise InputError(
                    f"row {rows[np.argmax(gaps)] + 1}{test} has no {what} along {axis}, others "
                    "have: give it, leave the row out, or name another test in a column 'protocol'"
                )


def _check_path(H: np.ndarray, pulls: np.ndarray, rows: np.ndarray, name: str) -> None:
    """Refuse a test that goes back: unloading, or a second test under the same name."""
    test = f" of '{name}'" if name else ""
    ways = np.linalg.norm(H, axis=(1, 2)), np.linalg.norm(np.nan_to_num(pulls), axis=1)
    back = np.flatnonzero(falls(ways[0]) | falls(ways[1]))
    if not len(back):
        return
    if _through_rest(H.reshape(len(H), 9)) or _through_rest(np.nan_to_num(pulls)):
        raise InputError(
            f"the rows{test} go through rest, from one side to the other: name the rows of either "
            f"side as a test of its own in a column '{PROTOCOL}', each from rest"
        )
    raise going_back(f"{test} is nearer to rest", rows, back[0], *ways)


def going_back(fault: str, rows: np.ndarray, back: int, *ways: np.ndarray) -> InputError:
    """Return the refusal of a test that goes back, from its distances from rest (k,).

    fault : what is said of a row.
    rows : the numbers of the test's rows, from 0; ``back`` is the first that goes back.
    """
    jumps = [np.diff(way) < -_JUMP * way.max() for way in ways]
    starts = np.flatnonzero(np.any(jumps, axis=0)) + 1
    parts = [part for way in ways for part in np.split(way, starts)]
    if not any(falls(way[::-1]).any() for way in ways):
        hint = (
            ", and so is each further one: reverse the rows of a test that was recorded while it "
            "unloads"
        )
    elif len(starts) and not any(len(p) < _FEWEST_HELD or falls(p).any() for p in parts):
        back = starts[0]
        hint = (
            " by one step, and rises again: if another test begins there, name the test of each "
            f"row in a column '{PROTOCOL}'"
        )
    else:
        hint = (
            f": rows of a test are in the order of its loading, unloading goes under '{UNLOADING}' "
            f"in a column '{BRANCH}', another test under another name in a column '{PROTOCOL}'"
        )
    return InputError(f"row {rows[back] + 1}{fault} than one before{hint}")


def falls(way: np.ndarray) -> np.ndarray:
    r"""Return whether each of a test's distances from rest (k,) is less than one before it.

    Measured ones may go back by 2 % of the largest, or by noise. Differences of second and fourth
    order show its sd s: a curve has small ones, and cycles of a few rows not both. The means of w
    neighbours of k rows of noise are within :math:`2 s \sqrt{2 \ln k / w}` of each other, so that
    a return of some rows is seen beside more noise than that of one.
    """
    count, largest, noise = len(way), way.max(), 0.0
    if count >= _FEWEST_NOISY:
        sizes = [np.median(np.abs(np.diff(way, k))) / v**0.5 for k, v in _DIFFERENCES]
        noise = min(sizes) / _MEDIAN
    admitted = _NOISE * np.sqrt(2.0 * np.log(count)) * noise * (noise < _MOST_NOISE * largest)
    result, width = np.zeros(count, bool), 1
    while width == 1 or 4 * width <= count:
        means = np.convolve(way, np.full(width, 1.0 / width), "valid")
        fall = np.maximum.accumulate(means) - means
        result[width - 1 :] |= fall > max(_BACK * largest, admitted / np.sqrt(width))
        width *= 2
    return result


def _through_rest(motion: np.ndarray) -> bool:
    """Return whether the states (k, c) of a test lie on one line through rest, in order."""
    along = motion @ (motion[-1] - motion[0])
    return bool(along[0] < 0.0 < along[-1] and not falls(along - along[0]).any())
