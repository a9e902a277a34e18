"""Measurement noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from emulator.errors import InputError


@dataclass(frozen=True)
class GaussianNoise:
    """Independent Gaussian noise on every number of an observation, in the observation's unit.

    Parameters
    ----------
    sd : standard deviation, when known: mm for displacements, on each component; mL for a volume.
    sd_scale : otherwise the scale of its half-normal prior; the sd is then inferred.
    """

    sd: float | None = None
    sd_scale: float | None = None

    def __post_init__(self) -> None:
        if (self.sd is None) == (self.sd_scale is None):
            raise InputError("noise: give either sd (known) or sd_scale (of its prior)")
        value = self.sd if self.sd is not None else self.sd_scale
        if value is None or not 0.0 < value < float("inf"):
            raise InputError(f"noise: standard deviation is {value}; it must be above 0")

    def describe(self) -> dict[str, Any]:
        """Plain JSON, the constructor's arguments."""
        return {"sd": self.sd, "sd_scale": self.sd_scale}
