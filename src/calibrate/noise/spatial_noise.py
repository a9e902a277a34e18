"""What noises with an independent and a spatial part have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
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


class SpatialNoise(ABC):
    r"""Noise of covariance :math:`\sigma^2 I + \omega^2 K`; its dataclass says what K is of.

    Attributes
    ----------
    length : correlation length of the reference positions, mm, known.
    sd, sd_scale : of the independent part: standard deviation, or scale of its half-normal prior.
    kernel : a name of :data:`calibrate.noise.spatial.KERNELS`.
    sites : where the data was measured; a model sets it.
    """

    length: float
    sd: float | None
    sd_scale: float | None
    kernel: str
    sites: Sites | None

    gaussian: ClassVar[bool] = True

    def __post_init__(self) -> None:
        spatial.check_kernel(self.length, self.kernel)
        self._independent, self._spatial  # noqa: B018 - values that cannot be are refused here

    @property
    @abstractmethod
    def _spatial(self) -> Scale:
        """Standard deviation of the part that correlates, known or inferred."""

    @property
    def _independent(self) -> Scale:
        return independent_sd(self.sd, self.sd_scale)

    @cached_property
    def _modes(self) -> spatial.SpatialModes:
        return spatial.spatial_modes(self.sites, self.length, self.kernel)

    def at(self, sites: Sites | None) -> Self:
        """The noise of data measured at ``sites``; :class:`InputError` where there are none."""
        bound = replace(self, sites=sites)  # type: ignore[type-var]
        bound._modes  # noqa: B018 - sites that cannot be are refused here
        return bound

    def inferred(self, scale: float) -> Self:
        """The noise with the sd of its independent part unknown."""
        return replace(self, sd=None, sd_scale=scale)  # type: ignore[type-var]

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Of both standard deviations, those of them that are not known."""
        return {**self._independent.priors, **self._spatial.priors}

    @property
    def upper_sd(self) -> float:
        """Largest plausible sd along a mode."""
        largest = self._modes.eigenvalues.max()
        return float(np.sqrt(self._independent.upper**2 + self._spatial.upper**2 * largest))

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Gaussian around ``mean``, the part that correlates integrated out."""
        sds = self._independent.value(values), self._spatial.value(values)
        return spatial.spatial_distribution(self._modes, mean, *sds)

    def to_json(self) -> dict[str, Any]:
        """Kind and the constructor's arguments, without the sites."""
        return describe(self)

    @classmethod
    def from_json(cls, description: Mapping[str, Any]) -> Self:
        """The noise that :meth:`to_json` described."""
        return restore(cls, description)
