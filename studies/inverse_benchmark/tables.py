"""Draws as comma-separated values: a column a parameter, and ``weight`` where draws have some."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from studies.common.output import replacing

import emulator as em


class Table(NamedTuple):
    """Draws (n, p), and their weights (n,), which sum to 1."""

    draws: np.ndarray
    weights: np.ndarray

    def mean(self) -> np.ndarray:
        """Mean, (p,)."""
        return self.weights @ self.draws

    def sd(self) -> np.ndarray:
        """Standard deviation, (p,)."""
        return np.sqrt(self.weights @ (self.draws - self.mean()) ** 2)

    def part(self, rows: slice) -> "Table":
        """Some of the draws."""
        weights = self.weights[rows]
        return Table(self.draws[rows], weights / weights.sum())


def write(
    path: Path, names: tuple[str, ...], draws: np.ndarray, weights: np.ndarray | None = None
) -> None:
    """Write draws (n, p), to five digits."""
    columns = draws if weights is None else np.column_stack([draws, weights])
    header = ",".join(names if weights is None else (*names, "weight"))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        np.savetxt(temporary, columns, fmt="%.5g", delimiter=",", header=header, comments="")


def read(path: Path, names: tuple[str, ...]) -> Table:
    """Read draws, columns in any order.

    Raises
    ------
    InputError
        Another column or none of a parameter, fewer than 50 rows, or a value that is not finite.
    """
    header = path.read_text().partition("\n")[0].strip().split(",")
    wanted = {*names, *(["weight"] if "weight" in header else [])}
    if set(header) != wanted or len(header) != len(wanted):
        raise em.InputError(f"{path}: columns are {', '.join(header)}; expected {', '.join(names)}")
    try:
        rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except ValueError as error:
        raise em.InputError(f"{path}: {error}") from None
    if len(rows) < 50 or not np.isfinite(rows).all():
        raise em.InputError(f"{path}: {len(rows)} rows; give 50 or more, all of finite numbers")
    weights = rows[:, header.index("weight")] if "weight" in header else np.ones(len(rows))
    if weights.min() < 0.0 or weights.sum() <= 0.0:
        raise em.InputError(f"{path}: a weight is negative, or all are 0")
    return Table(rows[:, [header.index(name) for name in names]], weights / weights.sum())
