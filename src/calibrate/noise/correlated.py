r"""Gaussian noise of which a part correlates in space.

Registration and tracking err alike in neighbouring points. The covariance is
:math:`\sigma^2 I + \omega^2 K` with the independent sd :math:`\sigma`, the spatial sd
:math:`\omega` and a kernel over reference positions (:mod:`calibrate.noise.spatial`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from calibrate.noise import spatial
from calibrate.noise.protocol import Sites
from calibrate.noise.scale import Scale
from calibrate.noise.spatial_noise import SpatialNoise

SPATIAL_SD = "spatial_sd"


@dataclass(frozen=True)
class CorrelatedNoise(SpatialNoise):
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
    usage: ClassVar[str] = "correlated:length=MM,sd=SD,spatial_sd=SD"

    @property
    def _spatial(self) -> Scale:
        options = ("spatial_sd", "spatial_sd_scale")
        return Scale(SPATIAL_SD, options, self.spatial_sd, self.spatial_sd_scale)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Noise of data of this shape; :class:`InputError` where an sd is not known."""
        sds = self._independent.needed(), self._spatial.needed()
        return spatial.simulate(self._modes, rng, *sds).reshape(shape)
