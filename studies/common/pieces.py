"""Real tests of pieces of tissue as tables, and the laws that people take for them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import emulator as em

POINTS = 6  # of a curve
HEART = ("holzapfel_ogden_orthotropic", "holzapfel_ogden", "guccione")
CLOT = ("ogden_1", "yeoh", "mooney_rivlin")
MUSCLE = ("holzapfel_ogden_unswitched", "guccione", "yeoh")
HEARTS = (1, 2, 3, 4, 5, 7, 8)
CLOTS = tuple(f"C{c}_T{t}_{axis}" for c in (10, 40) for t in (60, 90, 120) for axis in "xyz")
A_HEART, A_FEW_CLOTS = (4,), ("C10_T60_x", "C10_T120_y", "C40_T90_z")
MODES = ("fs", "fn", "ff", "sf", "sn", "ss", "nf", "ns", "nn")
"""The normal of the glued faces, and the direction of motion, of a sheep's nine modes."""
SIDE = 10.0  # mm of a clot

Columns = dict[str, np.ndarray]


@dataclass
class Piece:
    """Tests of one piece, or of pieces that stand for one.

    group : the data set. name : the piece. laws : those that are tried.
    tests, motions, rows : of each state its test, its motion from rest, and its numbers by column.
    """

    group: str
    name: str
    laws: tuple[str, ...]
    tests: list[str] = field(default_factory=list)
    motions: list[float] = field(default_factory=list)
    rows: list[dict[str, float]] = field(default_factory=list)

    def add(self, test: str, motion: np.ndarray, columns: Columns) -> None:
        """Add a few states of a test, in the order of ``motion`` (m,)."""
        order = np.argsort(motion)
        order = order[motion[order] > 1e-3]
        thin = np.linspace(0, len(order) - 1, min(POINTS, len(order))).astype(int)
        for k in order[thin]:
            self.tests.append(test)
            self.motions.append(float(motion[k]))
            self.rows.append({name: float(values[k]) for name, values in columns.items()})

    @property
    def stresses(self) -> list[str]:
        """The columns of stress, with their unit."""
        return [n for n in dict.fromkeys(n for row in self.rows for n in row) if "[kPa]" in n]

    @property
    def measured(self) -> np.ndarray:
        """The stresses (m, c) in kPa, NaN where there is none."""
        return np.array([[row.get(name, np.nan) for name in self.stresses] for row in self.rows])

    def reached(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Return whether a state lies below ``share`` of its test's motion, and motion over that.

        The latter is over the largest motion of the test below that share.
        """
        tests, motion = np.array(self.tests), np.array(self.motions)
        seen, ratio = np.zeros(len(tests), bool), np.full(len(tests), np.nan)
        for test in dict.fromkeys(self.tests):
            of = tests == test
            seen[of] = motion[of] <= share * motion[of].max() + 1e-9
            ratio[of] = motion[of] / motion[of & seen].max(initial=0.0)
        return seen, ratio

    def write(self, path: Path, rows: np.ndarray) -> None:
        """Write the table of some states (m,) of bool."""
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["protocol", *names])
            for k in np.flatnonzero(rows):
                numbers = (f"{self.rows[k][n]:.8g}" if n in self.rows[k] else "" for n in names)
                writer.writerow([self.tests[k], *numbers])


def _table(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        raise em.InputError(f"{path} does not exist; --data names the folder of the measurements")
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file, skipinitialspace=True))


def _numbers(path: Path) -> np.ndarray:
    return np.array([[float(value) for value in row.values()] for row in _table(path)])


def _of_motion(pair: str, amount: np.ndarray, stress: np.ndarray, kind: str) -> Columns:
    """Columns of a test of fibre, sheet or normal axes: moved along the second of ``pair``."""
    normal, along = ("xyz"["fsn".index(letter)] for letter in pair)
    if normal == along:
        return {f"stretch_{along}": 1.0 + amount, f"{kind}_{along} [kPa]": stress}
    held = {f"stretch_{axis}": np.ones(len(amount)) for axis in (along, normal)}
    plane = along + normal
    return {**held, f"shear_{plane}": amount, f"{kind}_{plane} [kPa]": stress}


def pigs(folder: Path) -> Iterator[Piece]:
    """Six shears of pigs' myocardium (Dokos et al. 2002)."""
    rows = _table(folder / "myocardium_tables" / "dokos_shear_experiment.csv")
    piece = Piece("pigs, sheared", "dokos", HEART)
    for mode in ("fs", "fn", "sf", "sn", "nf", "ns"):
        amount, stress = np.array([(r["x"], r["y"]) for r in rows if r["mode"] == mode], float).T
        piece.add(mode, amount, _of_motion(mode, amount, stress, "cauchy"))
    yield piece


def humans(folder: Path) -> Iterator[Piece]:
    """Human myocardium along two axes (Sommer et al. 2015), an axis of a ratio of strains each."""
    rows = _table(folder / "myocardium_tables" / "sommer_biaxial_experiment.csv")
    piece = Piece("humans, two axes", "sommer", HEART)
    for strain, ratio in dict.fromkeys((row["strain"], row["r"]) for row in rows):
        of = [(r["x"], r["y"]) for r in rows if (r["strain"], r["r"]) == (strain, ratio)]
        stretch, stress = np.array(of, float).T
        across = strain == "ss"
        other = 1.0 + (stretch - 1.0) * (float(ratio) if across else 1.0 / float(ratio))
        axis, second = "yx" if across else "xy"
        columns = {f"stretch_{axis}": stretch, f"stretch_{second}": other}
        piece.add(f"{strain} {ratio}", stretch - 1.0, {**columns, f"cauchy_{axis} [kPa]": stress})
    yield piece


def sheep(folder: Path, hearts: Sequence[int] = A_HEART) -> Iterator[Piece]:
    """Cubes of sheep's myocardium between glued plates, taken to deform evenly."""
    for heart in hearts:
        place = folder / "ovine_myocardium" / f"TSL{heart}"
        sizes = np.loadtxt(place / "WDH_Params.csv", delimiter=",").reshape(3, 3)
        piece = Piece("sheep, nine modes", f"TSL{heart}", HEART)
        for mode, pair in enumerate(MODES):
            table = _numbers(place / f"ForceStrain_M{mode + 1}.csv")
            amount, force = table[table[:, 0] > 0.0][:, :2].T
            width, depth, _ = sizes[mode // 3]
            piece.add(
                pair, amount, _of_motion(pair, amount, 1e3 * force / (width * depth), "stress")
            )
        yield piece


def clots(folder: Path, names: Sequence[str] = A_FEW_CLOTS) -> Iterator[Piece]:
    """Blood clots in simple shear, with normal stress."""
    for name in names:
        table = _numbers(folder / "blood_clots" / f"{name}.csv")
        amount, shear, normal = table[table[:, 0] > 0.0].T
        piece = Piece("clots, sheared", name, CLOT)
        columns = _of_motion("nf", amount, 1e3 * shear / SIDE**2, "stress")
        piece.add("xz", amount, columns | {"stress_zz [kPa]": 1e3 * normal / SIDE**2})
        yield piece


def muscle(folder: Path) -> Iterator[Piece]:
    """Pigs' muscle pressed in two directions, at one rate each; the ramp without the hold."""
    for rate in ("1", "0.5"):
        piece = Piece("muscle, pressed", f"{rate} % a second", MUSCLE)
        for direction, axis in zip("AB", "fs", strict=True):
            table = _numbers(folder / "muscle" / f"{direction}_30_{rate}.csv")
            _, stretch, stress = table[: int(np.argmin(table[:, 2])) + 1].T
            columns = _of_motion(2 * axis, stretch - 1.0, stress, "cauchy")
            piece.add(direction, 1.0 - stretch, columns)
        yield piece


SETS: tuple[Callable[[Path], Iterator[Piece]], ...] = (clots, muscle, humans, pigs, sheep)
