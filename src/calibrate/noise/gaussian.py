"""Independent Gaussian noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np
import numpyro.distributions as dist

from calibrate.noise.protocol import Noise, Scale


def independent_sd(sd: float | None, sd_scale: float | None) -> Scale:
    """Return the sd of independent Gaussian noise, called ``noise_sd`` where it is inferred."""
    return Scale("noise_sd", ("sd", "sd_scale"), sd, sd_scale)


@dataclass(frozen=True)
class GaussianNoise(Noise):
    """Independent Gaussian noise on every number of an observation, in the observation's unit.

    sd : standard deviation, when known: mm for displacements, on each component; mL for a volume.
    sd_scale : otherwise the scale of its half-normal prior; the sd is then inferred.
    """

    sd: float | None = None
    sd_scale: float | None = None

    kind: ClassVar[str] = "gaussian"

    @property
    def scales(self) -> tuple[Scale, ...]:
        """The standard deviation."""
        return (independent_sd(self.sd, self.sd_scale),)

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Return independent normal distributions around ``mean``."""
        return dist.Normal(mean, self.scales[0].value(values)).to_event(mean.ndim)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return noise of data of this shape; :class:`InputError` where the sd is not known."""
        return rng.normal(0.0, self.scales[0].needed(), shape)
