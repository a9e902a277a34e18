r"""A model that is wrong: Gaussian noise and a discrepancy between body and simulation.

.. math:: y = g(\theta) + \delta(X) + \varepsilon, \qquad
          \delta \sim \mathrm{GP}(0,\; \omega^2 k(|X - X'| / \ell))

(Kennedy and O'Hagan 2001, Equation 5, with scale factor 1). The discrepancy :math:`\delta` is
integrated out, which leaves the covariance :math:`\sigma^2 I + \omega^2 K`
(:mod:`calibrate.noise.spatial`); :math:`\omega` has a half-normal prior and is inferred.

Data alone cannot tell a discrepancy from a change of theta that looks the same (Brynjarsdóttir and
O'Hagan 2014). A mean of zero and a length that is given keep it from taking all shapes and sizes:
what is smoother than :math:`\ell` and explained by theta goes to theta. The posterior of theta
widens; it does not become right by itself where the model is wrong.
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
from calibrate.noise.gaussian import GaussianNoise, independent_sd
from calibrate.noise.protocol import Noise, Sites
from calibrate.noise.scale import Scale
from emulator.errors import InputError

DISCREPANCY_SD = "discrepancy_sd"


@dataclass(frozen=True)
class DiscrepancyNoise:
    """Independent Gaussian noise and a discrepancy of the model, in the observation's unit.

    Parameters
    ----------
    scale : of the half-normal prior of the discrepancy's standard deviation.
    length : correlation length of the discrepancy over reference positions, mm, known.
    sd, sd_scale : of the independent noise, as in :class:`~calibrate.noise.GaussianNoise`.
    kernel : a name of :data:`calibrate.noise.spatial.KERNELS`.
    sites : where the data was measured; a model sets it.
    """

    scale: float
    length: float
    sd: float | None = None
    sd_scale: float | None = None
    kernel: str = "matern32"
    sites: Sites | None = field(default=None, compare=False, repr=False)

    kind: ClassVar[str] = "discrepancy"
    gaussian: ClassVar[bool] = True
    usage: ClassVar[str] = "discrepancy:scale=SCALE,length=MM,sd=SD"

    def __post_init__(self) -> None:
        spatial.check_kernel(self.length, self.kernel)
        self._independent, self._discrepancy  # noqa: B018 - values that cannot be are refused here

    @property
    def _independent(self) -> Scale:
        return independent_sd(self.sd, self.sd_scale)

    @property
    def _discrepancy(self) -> Scale:
        return Scale(DISCREPANCY_SD, ("", "scale"), None, self.scale)

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
        """``discrepancy_sd``, and ``noise_sd`` where it is not known."""
        return {**self._independent.priors, **self._discrepancy.priors}

    @property
    def upper_sd(self) -> float:
        """Largest plausible sd along a mode."""
        largest = self._modes.eigenvalues.max()
        return float(np.sqrt(self._independent.upper**2 + self._discrepancy.upper**2 * largest))

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Gaussian around ``mean``, the discrepancy integrated out."""
        sds = self._independent.value(values), self._discrepancy.value(values)
        return spatial.spatial_distribution(self._modes, mean, *sds)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Independent noise alone: data made by the model itself has no discrepancy."""
        return rng.normal(0.0, self._independent.needed(), shape)

    def to_json(self) -> dict[str, Any]:
        """Kind and the constructor's arguments, without the sites."""
        return describe(self)

    @classmethod
    def from_json(cls, description: Mapping[str, Any]) -> Self:
        """The noise that :meth:`to_json` described."""
        return restore(cls, description)


def with_discrepancy(noise: Noise, options: Mapping[str, Any]) -> DiscrepancyNoise:
    """``noise`` and a discrepancy.

    Parameters
    ----------
    noise : independent Gaussian noise.
    options : ``scale``, ``length`` and perhaps ``kernel`` of a :class:`DiscrepancyNoise`.

    Raises
    ------
    InputError
        Noise of another kind, or options that are wrong.
    """
    given = noise.to_json()
    if given["kind"] != GaussianNoise.kind:
        raise InputError(
            f"a discrepancy adds to {GaussianNoise.kind} noise, not to {given['kind']} noise"
        )
    return DiscrepancyNoise.from_json({**given, **options})
