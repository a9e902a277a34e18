"""Independent Gaussian noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import numpy as np
import numpyro.distributions as dist

from calibrate.noise.description import describe, restore
from calibrate.noise.protocol import Sites
from calibrate.noise.scale import Scale

NOISE_SD = "noise_sd"


def independent_sd(sd: float | None, sd_scale: float | None) -> Scale:
    """The standard deviation of independent Gaussian noise, ``noise_sd`` where it is unknown."""
    return Scale(NOISE_SD, ("sd", "sd_scale"), sd, sd_scale)


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
    gaussian: ClassVar[bool] = True
    usage: ClassVar[str] = "gaussian:sd=SD"

    def __post_init__(self) -> None:
        self._scale  # noqa: B018 - values that cannot be are refused here

    @property
    def _scale(self) -> Scale:
        return independent_sd(self.sd, self.sd_scale)

    def at(self, sites: Sites | None) -> Self:
        """Itself: independent noise is the same everywhere."""
        return self

    def inferred(self, scale: float) -> Self:
        """Gaussian noise of unknown sd."""
        return type(self)(sd_scale=scale)

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """``noise_sd`` with its half-normal prior, where it is not known."""
        return self._scale.priors

    @property
    def upper_sd(self) -> float:
        """The sd, or the 99.7 % quantile of its half-normal prior."""
        return self._scale.upper

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Independent normals around ``mean``."""
        return dist.Normal(mean, self._scale.value(values)).to_event(mean.ndim)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Noise of data of this shape; :class:`InputError` where the sd is not known."""
        return rng.normal(0.0, self._scale.needed(), shape)

    def to_json(self) -> dict[str, Any]:
        """Kind and the constructor's arguments."""
        return describe(self)

    @classmethod
    def from_json(cls, description: Mapping[str, Any]) -> Self:
        """The noise that :meth:`to_json` described."""
        return restore(cls, description)
