"""The measurements: motion capture of six markers, read from the raw files.

The laboratory's x is up, z runs along the beam and y across it. Here everything is in the beam's
axes: x from the clamp to the free end, y across, z up, mm.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import c3d
import numpy as np

import emulator as em

SOURCE = "github.com/srl-ethz/diffPD_sim2real, commit 825e7b7, python/realbeam_experiments"
LENGTH, WIDTH = 100.0, 30.0  # mm
DENSITY = 1.07  # g/cm3
FORCE = 0.51012  # N, that hung in the second experiment
BLIND = 1.00062  # N, of the runs that are kept apart
# Where upstream's code puts the markers; they stand on pins, outside of the silicone.
TIP = np.array([[100.0, 15.0, 36.0], [100.0, -6.0, 24.0], [100.0, 36.0, 6.0]])
CLAMP = np.array([[6.0, -10.0, -1.0], [6.0, 40.0, 27.5], [6.0, 40.0, 0.0]])
_AXES = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
_HELD, _STATIC = 10, 100  # first frames, while a hand holds the tip; last ones, at rest


@dataclass(frozen=True)
class Recording:
    """Mean positions in mm of the markers, (3, 3) each.

    held, static : of the tip, while it is held up and at rest. clamp : at rest.
    """

    held: np.ndarray
    static: np.ndarray
    clamp: np.ndarray


def read(path: Path) -> Recording:
    """One recording in the beam's axes, its origin the laboratory's."""
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of every file without analog channels
        reader = c3d.Reader(file)
        frames = np.stack([points[:, :3] for _, points, _ in reader.read_frames()])
    if frames.shape[1] != 6:
        raise em.InputError(
            f"{path}: {frames.shape[1]} markers; expected 6, three of them on the tip"
        )
    positions = 1e3 * frames @ _AXES.T  # the files are in m
    held, static = positions[:_HELD].mean(axis=0), positions[-_STATIC:].mean(axis=0)
    return Recording(held[:3], static[:3], static[3:])


def recordings(folder: Path, pattern: str) -> list[Recording]:
    """The repeats of an experiment, in the files' order."""
    files = sorted(folder.glob(pattern))
    if not files:
        raise em.InputError(
            f"{folder} has no {pattern}; the recordings are those of {SOURCE}: give --data DIR"
        )
    return [read(path) for path in files]


@dataclass(frozen=True)
class Measured:
    """What the beam's model is told, in its frame, mm.

    rest : (3, 3) tip markers with the beam straight, as a hand held it.
    weight, loaded : (3, 3) displacements of them by the weight, and with the force besides.
    clamp : (3, 3) displacement of the clamp's markers between the two experiments.
    shift : (3,) from the laboratory's frame (in the beam's axes) to the mesh's.
    repeats : largest difference of two repeats, of the weight and of the force, mm.
    """

    rest: np.ndarray
    weight: np.ndarray
    loaded: np.ndarray
    clamp: np.ndarray
    shift: np.ndarray
    repeats: tuple[float, float]


def measured(folder: Path) -> Measured:
    """Both experiments, each the mean of its repeats."""
    light = recordings(folder, "beam_gravity_*.c3d")
    heavy = recordings(folder, "beam_load52_*.c3d")
    held = np.mean([each.held for each in light], axis=0)
    shift = (TIP - held).mean(axis=0)

    def apart(runs: list[Recording]) -> float:
        return float(np.ptp([run.static for run in runs], axis=0).max())

    def mean(runs: list[Recording], what: str) -> np.ndarray:
        return np.mean([getattr(run, what) for run in runs], axis=0)

    return Measured(
        rest=held + shift,
        weight=mean(light, "static") - held,
        loaded=mean(heavy, "static") - held,
        clamp=mean(heavy, "clamp") - mean(light, "clamp"),
        shift=shift,
        repeats=(apart(light), apart(heavy)),
    )
