"""The raw files: seven hearts, three cubes each, three modes a cube (README)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import emulator as em

MODES = ("FS", "FN", "FF", "SF", "SN", "SS", "NF", "NS", "NN")
"""In the files' order, three a cube: normal of the glued faces, direction of motion."""
LEVELS = 5
"""Points taken from either half of a curve, evenly over its amounts."""
_EDGES = (3.0, 40.0)  # mm; in cm or m they would be less
_FORCES = (0.02, 20.0)  # N, a heart's largest: 0.4 to 1 here; in mN or kN they would be outside
_SOURCE = (
    "github.com/SoftTissueBiomechanicsLab/ML-soft-material-parameters, folder "
    "ExperimentalMyocardiumData"
)


@dataclass(frozen=True)
class Curve:
    """One mode of one cube.

    amount : (j,) of shear, or engineering strain. force : (j,) N along the motion. normal : (j,) N
    normal to the plates, of a shear.
    """

    mode: str
    amount: np.ndarray
    force: np.ndarray
    normal: np.ndarray | None


@dataclass(frozen=True)
class Heart:
    """sizes : (3, 3) mm, of each cube: along its first and second shear, and between the plates."""

    name: str
    sizes: np.ndarray
    curves: dict[str, Curve]

    def of_cube(self, cube: int) -> list[Curve]:
        """The three curves of a cube, numbered from 0: two shears and a stretch."""
        return [self.curves[mode] for mode in MODES[3 * cube : 3 * cube + 3]]


def hearts(folder: Path) -> list[Heart]:
    """Every heart in ``folder``, one folder each.

    Raises
    ------
    InputError
        No hearts, or a file that is missing or does not hold what it should.
    """
    found = [heart(each) for each in sorted(folder.glob("TSL*")) if each.is_dir()]
    if not found:
        raise em.InputError(f"{folder} has no folders TSL1, TSL2, ...; get them from {_SOURCE}")
    return found


def heart(folder: Path) -> Heart:
    """One heart."""
    sizes = _table(folder / "WDH_Params.csv", 9, skip=0)
    low, high = _EDGES
    if sizes.shape != (1, 9) or not ((low < sizes) & (sizes < high)).all():
        raise em.InputError(
            f"{folder / 'WDH_Params.csv'}: expected 9 edge lengths in mm in one row, each of "
            f"{low:g} to {high:g}"
        )
    curves = {
        mode: curve(folder / f"ForceStrain_M{k}.csv", mode) for k, mode in enumerate(MODES, start=1)
    }
    largest = [np.abs(each.force).max() for each in curves.values()]
    k = int(np.argmax(largest))
    low, high = _FORCES
    if not low < largest[k] < high:
        raise em.InputError(
            f"{folder / f'ForceStrain_M{k + 1}.csv'}: forces reach {largest[k]:g}, the largest of "
            f"this heart; expected N, {low:g} to {high:g} of a centimetre of muscle"
        )
    return Heart(folder.name, sizes.reshape(3, 3), curves)


def curve(path: Path, mode: str) -> Curve:
    """Points of a mode's curve, ``LEVELS`` on either side of rest."""
    sheared = mode[0] != mode[1]
    table = _table(path, 3 if sheared else 2, skip=1)
    amount, force = table[:, 0], table[:, 1]
    if not (np.diff(amount) > 0.0).all() or not amount[0] < 0.0 < amount[-1]:
        raise em.InputError(f"{path}: amounts do not rise from below 0 to above it")
    if np.abs(amount).max() > 1.0:
        raise em.InputError(
            f"{path}: amounts reach {np.abs(amount).max():g}; expected fractions, not percent or mm"
        )
    fractions = np.arange(1, LEVELS + 1) / LEVELS
    wanted = np.concatenate([amount[0] * fractions[::-1], amount[-1] * fractions])
    rows = np.abs(amount[:, None] - wanted).argmin(axis=0)
    return Curve(mode, amount[rows], force[rows], table[rows, 2] if sheared else None)


def _table(path: Path, columns: int, *, skip: int) -> np.ndarray:
    """Numbers (r, columns) of a file."""
    if not path.is_file():
        raise em.InputError(f"{path} is missing; get it from {_SOURCE}")
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=skip, ndmin=2)
    except ValueError as error:
        raise em.InputError(f"{path} is not a table of numbers: {error}") from error
    if table.shape[1] != columns or not np.isfinite(table).all() or not len(table):
        raise em.InputError(
            f"{path} has {table.shape[1]} columns, or values that are not finite; expected "
            f"{columns} columns of finite numbers"
        )
    return table
