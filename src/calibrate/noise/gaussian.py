"""Independent Gaussian noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import numpy as np
import numpyro.distributions as dist

from calibrate.noise.protocol import Sites
from emulator.errors import InputError

NOISE_SD = "noise_sd"


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

    kind: ClassVar[str] = "gaussian"
    usage: ClassVar[str] = "gaussian:sd=SD"

    def __post_init__(self) -> None:
        if (self.sd is None) == (self.sd_scale is None):
            raise InputError("noise: give either sd (known) or sd_scale (of its prior)")
        value = self.sd if self.sd is not None else self.sd_scale
        if value is None or not 0.0 < value < float("inf"):
            raise InputError(f"noise: standard deviation is {value}; it must be above 0")

    def at(self, sites: Sites | None) -> Self:
        """Itself: independent noise does not know where."""
        return self

    def inferred(self, scale: float) -> Self:
        """Gaussian noise of unknown sd."""
        return type(self)(sd_scale=scale)

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """``noise_sd`` with its half-normal prior, where it is not known."""
        return {} if self.sd_scale is None else {NOISE_SD: dist.HalfNormal(self.sd_scale)}

    @property
    def upper_sd(self) -> float:
        """The sd, or the 99.7 % quantile of its half-normal prior."""
        return self.sd if self.sd is not None else 3.0 * (self.sd_scale or 0.0)

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Independent normals around ``mean``."""
        sd = values[NOISE_SD] if self.sd is None else self.sd
        return dist.Normal(mean, sd).to_event(mean.ndim)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Noise of data of this shape; :class:`InputError` where the sd is not known."""
        if self.sd is None:
            raise InputError("noise: to make data, give its standard deviation")
        return rng.normal(0.0, self.sd, shape)

    def to_json(self) -> dict[str, Any]:
        """Kind and the constructor's arguments."""
        return {"kind": self.kind, "sd": self.sd, "sd_scale": self.sd_scale}

    @classmethod
    def from_json(cls, description: Mapping[str, Any]) -> Self:
        """The noise that :meth:`to_json` described."""
        return cls(description["sd"], description["sd_scale"])
