r"""Errors that many numbers share, of a size that is inferred.

:math:`y = g(x) + \alpha V q + \varepsilon` with :math:`q \sim N(0, I)` marginalised and
:math:`\alpha` an unknown of the posterior under a half-normal prior: what a law is off by along
loading curves, which the curves themselves tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np
import numpyro.distributions as dist

from calibrate.statistical_model.error_modes import ErrorModes

_PLAUSIBLE = 3.0  # scales of a half-normal: its 99.7 % quantile


@dataclass(frozen=True, eq=False)
class SizedError(ErrorModes):
    """Systematic errors of one unknown size, after those of known sds.

    name, scale : of the size in the posterior, and of its half-normal prior.
    """

    name: str
    scale: float

    of_fem: ClassVar[bool] = True
    with_mesh: ClassVar[bool] = False

    def size(self, unknowns: jax.Array) -> jax.Array:
        """The last of the unknowns."""
        return unknowns[-1]

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Half-normal."""
        return {self.name: dist.HalfNormal(self.scale)}

    @property
    def largest(self) -> np.ndarray:
        """At the 99.7 % quantile of the prior."""
        return _PLAUSIBLE * self.scale * self.modes

    def arrays(self) -> dict[str, np.ndarray]:
        """All that changes a likelihood, by name."""
        names = ("weights", "strength", "modes", "scale")
        return {name: np.asarray(getattr(self, name)) for name in names}


jax.tree_util.register_dataclass(SizedError, ["weights", "strength", "modes"], ["name", "scale"])
