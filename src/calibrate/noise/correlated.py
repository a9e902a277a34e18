r"""Gaussian noise of which a part correlates in space.

Registration and tracking err alike in neighbouring points. The covariance is
:math:`\sigma^2 I + \omega^2 K` with the independent sd :math:`\sigma`, the spatial sd
:math:`\omega` and a kernel over reference positions (:mod:`calibrate.noise.spatial`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import jax
import numpy as np
import numpyro.distributions as dist

from calibrate.noise import spatial
from calibrate.noise.description import describe, restore
from calibrate.noise.gaussian import independent_sd
from calibrate.noise.protocol import Sites
from calibrate.noise.scale import Scale

SPATIAL_SD = "spatial_sd"


@dataclass(frozen=True)
class CorrelatedNoise:
    """Independent noise and noise that correlates over ``length``, in the observation's unit.

    Parameters
    ----------
    length : correlation length of the reference positions, mm, known.
    sd, sd_scale : of the independent part: standard deviation, or scale of its half-normal prior.
    spatial_sd, spatial_sd_scale : the same for the part that correlates.
    kernel : a name of :data:`calibrate.noise.spatial.KERNELS`.
    sites : where the data was measured; a model sets it.
    """

    length: float
    sd: float | None = None
    sd_scale: float | None = None
    spatial_sd: float | None = None
    spatial_sd_scale: float | None = None
    kernel: str = "matern32"
    sites: Sites | None = field(default=None, compare=False, repr=False)

    kind: ClassVar[str] = "correlated"
    gaussian: ClassVar[bool] = True
    usage: ClassVar[str] = "correlated:length=MM,sd=SD,spatial_sd=SD"

    def __post_init__(self) -> None:
        spatial.check_kernel(self.length, self.kernel)
        self._independent, self._spatial  # noqa: B018 - values that cannot be are refused here

    @property
    def _independent(self) -> Scale:
        return independent_sd(self.sd, self.sd_scale)

    @property
    def _spatial(self) -> Scale:
        options = ("spatial_sd", "spatial_sd_scale")
        return Scale(SPATIAL_SD, options, self.spatial_sd, self.spatial_sd_scale)

    @cached_property
    def _modes(self) -> spatial.SpatialModes:
        return spatial.spatial_modes(self.sites, self.length, self.kernel)

    def at(self, sites: Sites | None) -> Self:
        """The noise of data measured at ``sites``; :class:`InputError` where there are none."""
        bound = replace(self, sites=sites)
        bound._modes  # noqa: B018 - sites that cannot be are refused here
        return bound

    def inferred(self, scale: float) -> Self:
        """The noise with the sd of its independent part unknown."""
        return replace(self, sd=None, sd_scale=scale)

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """``noise_sd`` and ``spatial_sd``, those of them that are not known."""
        return {**self._independent.priors, **self._spatial.priors}

    @property
    def upper_sd(self) -> float:
        """Largest plausible sd along a mode."""
        largest = self._modes.eigenvalues.max()
        return float(np.sqrt(self._independent.upper**2 + self._spatial.upper**2 * largest))

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Gaussian around ``mean``, correlated in space."""
        sds = self._independent.value(values), self._spatial.value(values)
        return spatial.spatial_distribution(self._modes, mean, *sds)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Noise of data of this shape; :class:`InputError` where an sd is not known."""
        sds = self._independent.needed(), self._spatial.needed()
        return spatial.simulate(self._modes, rng, *sds).reshape(shape)

    def to_json(self) -> dict[str, Any]:
        """Kind and the constructor's arguments, without the sites."""
        return describe(self)

    @classmethod
    def from_json(cls, description: Mapping[str, Any]) -> Self:
        """The noise that :meth:`to_json` described."""
        return restore(cls, description)
