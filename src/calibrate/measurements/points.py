"""What all observations of displacements at points share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from calibrate.measurements.protocol import LENGTH_UNITS, Field, Labels
from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Sites
from emulator.core.errors import InputError

DISPLACEMENT = "displacement"
DISPLACEMENT_FIELD = Field(DISPLACEMENT, ("ux", "uy", "uz"))


class DisplacementPoints:
    """Displacements (d, 3) in mm of points at ``points`` (d, 3) in the reference body.

    Unless a subclass gives it another name, at most one such observation fits in a file, and it is
    called ``displacement`` there.
    """

    points: np.ndarray

    quantity: ClassVar[str] = DISPLACEMENT
    unit: ClassVar[str] = "mm"
    other_units: ClassVar[Mapping[str, float]] = LENGTH_UNITS
    default_noise: ClassVar[GaussianNoise] = GaussianNoise(sd=0.2)

    @property
    def names(self) -> tuple[str, ...]:
        """``displacement``."""
        return (DISPLACEMENT,)

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, 3)."""
        return self.points.shape

    @property
    def sites(self) -> Sites:
        """The points, for each component."""
        return Sites.of(self.points, 3)

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` unless ``values`` is (d, 3), each finite or missing."""
        check_values(name, values, self.shape, self.unit)

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


def check_values(name: str, values: np.ndarray, shape: tuple[int, ...], unit: str) -> None:
    """Raise :class:`InputError` unless ``values`` has this ``shape``, each finite or missing."""
    if values.shape != shape:
        raise InputError(
            f"data has shape {values.shape}; the observation expects {shape} ({name}, {unit})"
        )
    infinite = np.isinf(values).reshape(len(values), -1).any(axis=1)
    if infinite.any():
        raise InputError(f"data: {name}, row {int(np.argmax(infinite))} has an infinite value")


def check_table(where: np.ndarray, values: np.ndarray, what: str = "displacement") -> None:
    """Raise :class:`InputError` on a table of no use.

    Parameters
    ----------
    where : (d,) or (d, 3), finite.
    values : (d, k), k being 3 for displacements; each finite or, where missing, NaN.
    what : is measured, for errors.
    """
    wrong = values.ndim != 2 or not len(values)
    if wrong or (what == "displacement" and values.shape[1] != 3):
        raise InputError(f"{what}s have shape {values.shape}; expected (d, 3)")
    if len(where) != len(values):
        raise InputError(f"{len(where)} points have {len(values)} {what}s")
    unknown = ~np.isfinite(where.reshape(len(where), -1))
    for word, bad in (("position", unknown), (what, np.isinf(values))):
        if bad.any():
            row = int(np.argmax(bad.any(axis=1)))
            raise InputError(f"row {row + 1} has a {word} that is not finite; repair it")


def check_distinct(points: np.ndarray, what: str) -> None:
    """Raise :class:`InputError` where two of ``points`` (d, 3) mm are one: data counted twice."""
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[inverse.ravel()] != np.arange(len(points)))
    if again.size:
        k = int(again[0])
        raise InputError(
            f"{what} {first[inverse.ravel()[k]]} and {k} are both at {points[k].tolist()} mm; give "
            "each place once, repeated measurements as their mean, with less noise"
        )


def count_of(word: str, kind: str) -> int | None:
    """N of ``<kind>:N``; ``None`` for other words; :class:`InputError` when N is no number."""
    found, colon, text = word.partition(":")
    if found != kind or not colon:
        return None
    if not (text.isascii() and text.isdigit()) or int(text) < 1:
        raise InputError(f"observe '{word}': '{text}' is not a number of {kind}")
    return int(text)
