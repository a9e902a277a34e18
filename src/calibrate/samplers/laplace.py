r"""The Laplace approximation: a Gaussian at the posterior's mode, in unconstrained coordinates.

.. math:: z \sim \mathcal{N}\!\left(\hat z, H^{-1}\right), \qquad
          H = -\nabla^2 \log p(\hat z \mid y)

(Gelman et al. 2013, Sec. 4.1, 13.3). Draws are independent, so R-hat and effective sample size say
nothing of the error. The ratios :math:`p(z \mid y) / q(z)` do: the Pareto shape k of their tail is
recorded, and above 0.7 the Gaussian should not be trusted (Yao et al. 2018). A Gaussian that is too
wide has no such tail; few of its draws then count, and what fraction is recorded too. Neither sees
another mode, where no draw is; the optimiser's other starts do (:mod:`calibrate.samplers.modes`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_triangular

from calibrate.samplers.density import Density
from calibrate.samplers.importance import FEWEST, efficiency, pareto_shape
from calibrate.samplers.modes import Modes, find_modes, missed_mode, precision_at, slope_of
from calibrate.samplers.options import check_counts
from calibrate.samplers.protocol import Context, Draws
from calibrate.statistical_model import Data
from emulator.core.errors import InputError, SolverError

_AWAY = 0.05  # sd that the optimiser may stop from the mode


@dataclass(frozen=True)
class LaplaceOptions:
    """Size of a run.

    draws, chains : independent draws, and how many sets of them.
    starts : draws of the prior that the optimiser starts from; the best mode is taken.
    """

    draws: int = 1000
    chains: int = 4
    starts: int = 8

    label: ClassVar[str] = "Laplace"

    @classmethod
    def sized(cls, *, warmup: int, draws: int, chains: int) -> Self:  # noqa: ARG003
        """Options of a run of this size; there is no warm-up."""
        return cls(draws=draws, chains=chains)

    def __post_init__(self) -> None:
        check_counts(self, "draws", "chains", "starts")
        if self.draws * self.chains < FEWEST:
            raise InputError(
                f"{self.label}: {self.draws} draws of {self.chains} chains; give {FEWEST} or more "
                "together, or its error cannot be estimated"
            )


class _Gaussian(NamedTuple):
    """Mode (p,), precision H (p, p), and all modes that were found, the highest first."""

    mode: Any
    precision: Any
    modes: Any


@dataclass(frozen=True)
class Laplace:
    """The sampler; see :class:`~calibrate.samplers.protocol.Sampler`."""

    name: str = "laplace"
    options: type[LaplaceOptions] = LaplaceOptions
    statistics: tuple[str, ...] = ("lp", "log_ratio")
    solves_fem: bool = False

    def sample(
        self,
        density: Density,
        data: Data,
        options: LaplaceOptions,
        seed: int,
        context: Context = Context(),
    ) -> Draws:
        """Independent draws of the Gaussian where the density is not zero.

        The statistic ``log_ratio`` is log p(z, y) - log q(z). The attribute ``pareto_k`` is the
        shape of its tail, ``importance_efficiency`` the effective fraction of the draws, were they
        weighted by the ratios: 1 where the posterior is Gaussian.

        Raises
        ------
        SolverError
            No mode was found, the density is flat there, or half of the Gaussian lies where it is
            zero.
        """
        start_key, key = jax.random.split(jax.random.key(seed))
        gaussian = context.checkpoint.restore(lambda: _empty(density.dimension))
        if gaussian is None:
            modes = find_modes(density, data, start_key, options.starts)
            if not len(modes.z):
                raise SolverError(
                    "the posterior density is zero wherever the optimiser could start"
                )
            gaussian = _Gaussian(modes.z[0], _precision(density, data, modes.z[0]), modes)
            context.checkpoint.keep(lambda: gaussian)
        z, lp, log_q = _draw(density, gaussian, data, options, key)
        shape = (options.chains, options.draws)
        statistics = {"lp": lp.reshape(shape), "log_ratio": (lp - log_q).reshape(shape)}
        attributes = {
            "approximation": "gaussian",
            "pareto_k": pareto_shape(lp - log_q),
            "importance_efficiency": efficiency(lp - log_q),
            **missed_mode(density, data, z, Modes(*gaussian.modes)),
        }
        return Draws(z.reshape(*shape, -1), statistics, attributes)


def _empty(size: int) -> _Gaussian:
    modes = Modes(np.zeros((0, size)), np.zeros(0))
    return _Gaussian(np.zeros(size), np.zeros((size, size)), modes)


@lru_cache(maxsize=4)
def _heights(density: Density) -> Callable[..., Any]:
    """``(z (s, p), data) -> log densities (s,)``."""
    return jax.jit(lambda z, data: jax.lax.map(lambda row: density.log_density(row, data), z))


def _precision(density: Density, data: Data, mode: np.ndarray) -> np.ndarray:
    """Minus the Hessian at the mode; :class:`SolverError` where it is none."""
    precision = precision_at(density, data, mode)
    smallest = np.linalg.eigvalsh(precision)[0] if np.isfinite(precision).all() else np.nan
    if not smallest > 0.0:
        raise SolverError(
            f"the posterior has no curvature at its mode in some direction ({smallest:.2g}): it is "
            "flat there, or ends; use a sampler, such as nuts"
        )
    here = slope_of(density, data)(mode)
    away = float(np.sqrt(here @ np.linalg.solve(precision, here)))
    if not away < _AWAY:
        raise SolverError(
            f"the optimiser stopped {away:.2g} sd from a mode: the posterior density ends or bends "
            "sharply there; use a sampler, such as nuts"
        )
    return precision


def _draw(
    density: Density, gaussian: _Gaussian, data: Data, options: LaplaceOptions, key: jax.Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws (s, p), log densities and the Gaussian's, (s,); twice as many are tried."""
    wanted, size = options.chains * options.draws, len(gaussian.mode)
    noise = np.asarray(jax.random.normal(key, (2 * wanted, size)))
    # H = L L^T, so L^-T times white noise has covariance H^-1.
    factor = np.linalg.cholesky(gaussian.precision)
    z = gaussian.mode + solve_triangular(factor, noise.T, lower=True, trans="T").T
    lp = np.asarray(_heights(density)(jnp.asarray(z), data))
    rows = np.flatnonzero(np.isfinite(lp))[:wanted]
    if len(rows) < wanted:
        raise SolverError(
            "half of the Gaussian at the mode lies where the posterior density is zero; use a "
            "sampler, such as nuts"
        )
    log_q = -0.5 * (noise**2).sum(axis=1) + np.log(np.diag(factor)).sum()
    return z[rows], lp[rows], log_q[rows] - 0.5 * size * np.log(2.0 * np.pi)


LAPLACE = Laplace()
