r"""Independent noise with outliers: Student's t distribution.

.. math::
    p(\varepsilon) = \frac{\Gamma(\frac{\nu+1}{2})}{\Gamma(\frac{\nu}{2})\sqrt{\nu\pi}\,s}
    \left[1 + \frac{\varepsilon^2}{\nu s^2}\right]^{-(\nu+1)/2}

with scale :math:`s` and :math:`\nu` degrees of freedom. Far out its log density grows like
:math:`-(\nu + 1)\log|\varepsilon|` and not like :math:`-\varepsilon^2`: one outlier does not move
the posterior (Lange, Little and Taylor 1989). Its standard deviation is
:math:`s\sqrt{\nu/(\nu-2)}`, infinite at 2 degrees of freedom or fewer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import jax
import numpy as np
import numpyro.distributions as dist

from calibrate.noise.description import describe, restore
from calibrate.noise.protocol import Sites
from calibrate.noise.scale import Scale, check_positive

NOISE_SCALE = "noise_scale"
_FAR = 5.0  # sds of a Gaussian, at which data is judged (`calibrate.measurements.magnitude`)


@dataclass(frozen=True)
class StudentTNoise:
    """Independent Student-t noise on every number of an observation, in the observation's unit.

    Parameters
    ----------
    dof : degrees of freedom, known, above 0; 4 is usual, and 1 is the Cauchy distribution.
    scale : when known. It is not the standard deviation, which is larger.
    prior_scale : otherwise the scale of its half-normal prior; the scale is then inferred.
    """

    dof: float
    scale: float | None = None
    prior_scale: float | None = None

    kind: ClassVar[str] = "student_t"
    gaussian: ClassVar[bool] = False
    usage: ClassVar[str] = "student_t:dof=DOF,scale=SCALE"

    def __post_init__(self) -> None:
        check_positive("number of degrees of freedom", self.dof)
        self._scale  # noqa: B018 - values that cannot be are refused here

    @property
    def _scale(self) -> Scale:
        options = ("scale", "prior_scale")
        return Scale(NOISE_SCALE, options, self.scale, self.prior_scale)

    def at(self, sites: Sites | None) -> Self:
        """Itself: independent noise is the same everywhere."""
        return self

    def inferred(self, scale: float) -> Self:
        """Student-t noise of unknown scale and the same degrees of freedom."""
        return replace(self, scale=None, prior_scale=scale)

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """``noise_scale`` with its half-normal prior, where it is not known."""
        return self._scale.priors

    @property
    def upper_sd(self) -> float:
        """Sd of the Gaussian that has as much mass beyond five of its own sds."""
        from scipy import stats  # half a second, for this noise alone

        beyond = float(stats.t.isf(stats.norm.sf(_FAR), self.dof))
        return self._scale.upper * beyond / _FAR

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Independent Student-t distributions around ``mean``."""
        return dist.StudentT(self.dof, mean, self._scale.value(values)).to_event(mean.ndim)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Noise of data of this shape; :class:`InputError` where the scale is not known."""
        return self._scale.needed() * rng.standard_t(self.dof, shape)

    def to_json(self) -> dict[str, Any]:
        """Kind and the constructor's arguments."""
        return describe(self)

    @classmethod
    def from_json(cls, description: Mapping[str, Any]) -> Self:
        """The noise that :meth:`to_json` described."""
        return restore(cls, description)
