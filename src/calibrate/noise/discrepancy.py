r"""A model that is wrong: Gaussian noise and a discrepancy between body and simulation.

.. math:: y = g(\theta) + \delta(X) + \varepsilon, \qquad
          \delta \sim \mathrm{GP}(0,\; \omega^2 k(|X - X'| / \ell))

(Kennedy and O'Hagan 2001, Equation 5, with scale factor 1). The discrepancy :math:`\delta` is
integrated out, which leaves the covariance :math:`\sigma^2 I + \omega^2 K`
(:mod:`calibrate.noise.correlated`); :math:`\omega` has a half-normal prior and is inferred.

Data alone cannot tell a discrepancy from a change of theta that looks the same (Brynjarsdóttir and
O'Hagan 2014). A mean of zero and a length that is given keep it from taking all shapes and sizes:
what is smoother than :math:`\ell` and explained by theta goes to theta. The posterior of theta
widens; it does not become right by itself where the model is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from calibrate.noise.correlated import SpatialNoise
from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Noise, Scale, Sites
from emulator.core import schema
from emulator.core.errors import InputError


@dataclass(frozen=True)
class DiscrepancyNoise(SpatialNoise):
    """Independent Gaussian noise and a discrepancy of the model, in the observation's unit.

    scale : the scale of the half-normal prior of the discrepancy's standard deviation.
    length : the known correlation length of the discrepancy over reference positions, mm.
    sd, sd_scale : the options of the independent noise (:class:`~calibrate.noise.GaussianNoise`).
    """

    scale: float
    length: float
    sd: float | None = None
    sd_scale: float | None = None
    kernel: str = "matern32"
    sites: Sites | None = field(default=None, compare=False, repr=False)

    kind: ClassVar[str] = "discrepancy"
    usage: ClassVar[str] = "discrepancy:scale=SCALE,length=MM,sd=SD"

    @property
    def spatial(self) -> Scale:
        """Standard deviation of the discrepancy, which is always inferred."""
        return Scale("discrepancy_sd", ("", "scale"), None, self.scale)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return independent noise alone: data made by the model itself has no discrepancy."""
        return rng.normal(0.0, self.scales[0].needed(), shape)


def with_discrepancy(noise: Noise, options: Mapping[str, Any]) -> DiscrepancyNoise:
    """Return ``noise`` and a discrepancy.

    noise : independent Gaussian noise.
    options : ``scale``, ``length`` and perhaps ``kernel`` of a :class:`DiscrepancyNoise`.

    :class:`InputError` for noise of another kind, or options that are wrong.
    """
    if noise.kind != GaussianNoise.kind:
        raise InputError(
            f"a discrepancy adds to {GaussianNoise.kind} noise, not to {noise.kind} noise"
        )
    kinds = {DiscrepancyNoise.kind: DiscrepancyNoise}
    own = {**noise.to_json(), **options, "kind": DiscrepancyNoise.kind}
    return schema.restore(kinds, own, "noise")
