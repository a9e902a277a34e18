r"""The Laplace approximation: a Gaussian at the mode.

The approximation is a Gaussian at the mode, in unconstrained coordinates,

.. math:: z \sim \mathcal{N}\!\left(\hat z, H^{-1}\right), \qquad
          H = -\nabla^2 \log p(\hat z \mid y)

(Gelman et al. 2013, Sec. 4.1, 13.3). Draws are independent, so R-hat and effective sample size say
nothing of the error. The ratios :math:`p(z \mid y) / q(z)` do: the Pareto shape k of their tail is
recorded, and above 0.7 the Gaussian should not be trusted (Yao et al. 2018). A Gaussian that is too
wide has no such tail; few of its draws then count, and their fraction is recorded too. Neither sees
another mode, where no draw is; :mod:`calibrate.samplers.modes` looks for those.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np

from calibrate.importance.weights import FEWEST_WEIGHTS, effective, normalised, pareto_shape
from calibrate.samplers.modes import (
    Ends,
    climb_from,
    coloured,
    curvature,
    missed_mode,
    modes_at,
)
from calibrate.samplers.protocol import Context, Draws, Options, Sampler
from calibrate.statistical_model import Data
from calibrate.statistical_model.density import Density, heights, prior_draws
from emulator.core.errors import InputError, SolverError

_STARTS = 8  # draws of the prior from which modes are searched
_AWAY = 0.05  # largest distance from the mode, in sd, at which the optimiser may stop


@dataclass(frozen=True)
class LaplaceOptions(Options):
    """Size of a run.

    draws, chains : the number of independent draws of a set, and of sets.
    starts : the number of draws of the prior that the optimiser starts from; the highest mode is
        taken.
    """

    draws: int = 1000
    chains: int = 4
    starts: int = _STARTS

    label: ClassVar[str] = "Laplace"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.draws * self.chains < FEWEST_WEIGHTS:
            raise InputError(
                f"{self.label}: {self.draws} draws of {self.chains} chains; give {FEWEST_WEIGHTS} "
                "or more together, or its error cannot be estimated"
            )


class _Gaussian(NamedTuple):
    """Mode (p,), precision H (p, p), and the ends of all climbs."""

    mode: Any
    precision: Any
    ends: Any


class Laplace(Sampler):
    """The sampler of the Laplace approximation."""

    def sample(
        self, density: Density, data: Data, options: LaplaceOptions, context: Context
    ) -> Draws:
        """Return independent draws of the Gaussian where the density is not zero.

        The statistic ``log_ratio`` is log p(z, y) - log q(z). The attribute ``pareto_k`` is the
        shape of its tail, ``importance_efficiency`` the effective fraction of the draws, were they
        weighted by the ratios: 1 where the posterior is Gaussian.

        Raises
        ------
        SolverError
            No mode exists, the density is flat there, or half of the Gaussian lies where it is
            zero.
        """
        start_key, key = jax.random.split(jax.random.key(context.seed))
        number = np.zeros(())
        template = _Gaussian(number, number, Ends(number, number))
        gaussian = context.checkpoint.restore(lambda: template)
        if gaussian is None:
            ends = climb_from(density, data, prior_draws(density, start_key, options.starts))
            if not len(ends.z):
                raise SolverError(
                    "the posterior density is zero wherever the optimiser could start"
                )
            precision, smallest, distance = curvature(density, data, ends.z[0])
            if not smallest > 0.0:
                raise SolverError(
                    f"the posterior has no curvature at its mode in some direction ({smallest:.2g})"
                    ": it is flat there, or ends; use a sampler, such as nuts"
                )
            if not distance < _AWAY:
                raise SolverError(
                    f"the optimiser stopped {distance:.2g} sd from a mode: the posterior density "
                    "ends or bends sharply there; use a sampler, such as nuts"
                )
            gaussian = _Gaussian(ends.z[0], precision, ends)
            context.checkpoint.keep(lambda: gaussian)
        z, lp, log_q = _draw(density, gaussian, data, options, key)
        shape = (options.chains, options.draws)
        statistics = {"lp": lp.reshape(shape), "log_ratio": (lp - log_q).reshape(shape)}
        attributes = {
            "approximation": "gaussian",
            "pareto_k": pareto_shape(lp - log_q),
            "importance_efficiency": effective(normalised(lp - log_q)) / len(lp),
            **missed_mode(density, data, z, modes_at(density, data, gaussian.ends)),
        }
        return Draws(z.reshape(*shape, -1), statistics, attributes)


LAPLACE: Sampler = Laplace("laplace", LaplaceOptions)


def _draw(
    density: Density, gaussian: _Gaussian, data: Data, options: LaplaceOptions, key: jax.Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return draws (s, p), log densities and the Gaussian's, (s,), of twice as many trials."""
    count, size = options.chains * options.draws, len(gaussian.mode)
    noise = np.asarray(jax.random.normal(key, (2 * count, size)))
    factor = np.linalg.cholesky(gaussian.precision)
    z = gaussian.mode + coloured(noise, factor)
    at = heights(density, z, data)
    lp = at.prior + at.likelihood
    rows = np.flatnonzero(np.isfinite(lp))[:count]
    if len(rows) < count:
        raise SolverError(
            "half of the Gaussian at the mode lies where the posterior density is zero; use a "
            "sampler, such as nuts"
        )
    log_q = -0.5 * (noise**2).sum(axis=1) + np.log(np.diag(factor)).sum()
    return z[rows], lp[rows], log_q[rows] - 0.5 * size * np.log(2.0 * np.pi)
