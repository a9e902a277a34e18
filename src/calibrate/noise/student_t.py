r"""Independent noise with outliers: Student's t distribution.

.. math::
    p(\varepsilon) = \frac{\Gamma(\frac{\nu+1}{2})}{\Gamma(\frac{\nu}{2})\sqrt{\nu\pi}\,s}
    \left[1 + \frac{\varepsilon^2}{\nu s^2}\right]^{-(\nu+1)/2}

with scale :math:`s` and :math:`\nu` degrees of freedom. In its tails the log density falls like
:math:`-(\nu + 1)\log|\varepsilon|` and not like :math:`-\varepsilon^2`: one outlier does not move
the posterior (Lange, Little and Taylor 1989). Its standard deviation is
:math:`s\sqrt{\nu/(\nu-2)}`, infinite at 2 degrees of freedom or fewer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import jax
import numpy as np
import numpyro.distributions as dist

from calibrate.noise.protocol import Noise, Scale, check_positive

_FAR = 5.0  # sds beyond which data counts as far off (`calibrate.measurements.magnitude`)


@dataclass(frozen=True)
class StudentTNoise(Noise):
    """Independent Student-t noise on every number of an observation, in the observation's unit.

    dof : degrees of freedom, known, above 0; 4 is usual, and 1 is the Cauchy distribution.
    scale : when known. It is not the standard deviation, which is larger.
    prior_scale : otherwise the scale of its half-normal prior; the scale is then inferred.
    """

    dof: float
    scale: float | None = None
    prior_scale: float | None = None

    kind: ClassVar[str] = "student_t"
    gaussian: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_positive("number of degrees of freedom", self.dof)
        super().__post_init__()

    @property
    def scales(self) -> tuple[Scale, ...]:
        """The scale s."""
        return (Scale("noise_scale", ("scale", "prior_scale"), self.scale, self.prior_scale),)

    @property
    def upper_sd(self) -> float:
        """Sd of the Gaussian that has the same tail probability at five of its sds."""
        from scipy import stats  # the import takes half a second, and only this noise needs it

        beyond = float(stats.t.isf(stats.norm.sf(_FAR), self.dof))
        return self.scales[0].upper * beyond / _FAR

    def inferred(self, scale: float) -> Self:
        """Return Student-t noise of unknown scale, its degrees of freedom unchanged."""
        return replace(self, scale=None, prior_scale=scale)

    def distribution(self, mean: jax.Array, values: Mapping[str, jax.Array]) -> dist.Distribution:
        """Return independent Student-t distributions around ``mean``."""
        return dist.StudentT(self.dof, mean, self.scales[0].value(values)).to_event(mean.ndim)

    def simulate(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return noise of data of this shape; :class:`InputError` where the scale is not known."""
        return self.scales[0].needed() * rng.standard_t(self.dof, shape)
