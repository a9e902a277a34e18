"""What all observations of displacements at points share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from calibrate.noise.gaussian import GaussianNoise
from calibrate.observations.protocol import Field, Labels
from emulator.errors import InputError

DISPLACEMENT = "displacement"
DISPLACEMENT_FIELD = Field(DISPLACEMENT, ("ux", "uy", "uz"))


class DisplacementPoints:
    """Displacements (d, 3) in mm of points at ``points`` (d, 3) in the reference body.

    At most one such observation fits in a file, and it is called ``displacement`` there.
    """

    points: np.ndarray

    quantity: ClassVar[str] = DISPLACEMENT
    unit: ClassVar[str] = "mm"
    other_units: ClassVar[Mapping[str, float]] = {"m": 1e3, "cm": 10.0, "µm": 1e-3}
    names: ClassVar[tuple[str, ...]] = (DISPLACEMENT,)
    default_noise: ClassVar[GaussianNoise] = GaussianNoise(sd=0.2)

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, 3)."""
        return self.points.shape

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` unless ``values`` is (d, 3) and finite."""
        if values.shape != self.shape:
            raise InputError(
                f"data has shape {values.shape}; the observation expects {self.shape}"
                f" ({name}, {self.unit})"
            )
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise InputError(f"data: row {row} has a value that is not finite; remove that point")

    def labels(self, name: str) -> Labels:
        """Points and components; the reference positions as a constant."""
        # Only one observation is called `displacement`; it keeps the plain labels.
        suffix = "" if name == self.quantity else f"_{name}"
        point, position = f"point{suffix}", f"position{suffix}"
        return Labels(
            dims={name: [point, "component"], position: [point, "component"]},
            coords={point: np.arange(len(self.points)), "component": ["x", "y", "z"]},
            constants={position: self.points},
        )


def check_table(where: np.ndarray, displacement: np.ndarray) -> None:
    """Raise :class:`InputError` on points (d,) or (d, 3) or displacements that cannot be used."""
    if displacement.ndim != 2 or displacement.shape[1] != 3 or not len(displacement):
        raise InputError(f"displacements have shape {displacement.shape}; expected (d, 3)")
    if len(where) != len(displacement):
        raise InputError(f"{len(where)} points have {len(displacement)} displacements")
    for what, array in (("position", where), ("displacement", displacement)):
        bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"row {row + 1} has a {what} that is not finite; repair it")


def count_of(word: str, kind: str) -> int | None:
    """N of ``<kind>:N``; ``None`` for other words; :class:`InputError` when N is no number."""
    found, colon, text = word.partition(":")
    if found != kind or not colon:
        return None
    if not (text.isascii() and text.isdigit()) or int(text) < 1:
        raise InputError(f"observe '{word}': '{text}' is not a number of {kind}")
    return int(text)
