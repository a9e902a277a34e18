r"""The Laplace approximation: a Gaussian at the posterior's mode, in unconstrained coordinates.

.. math:: z \sim \mathcal{N}\!\left(\hat z, H^{-1}\right), \qquad
          H = -\nabla^2 \log p(\hat z \mid y)

(Gelman et al. 2013, Sec. 4.1, 13.3). Draws are independent, so R-hat and effective sample size say
nothing of the error. The ratios :math:`p(z \mid y) / q(z)` do: the Pareto shape k of their tail is
recorded, and above 0.7 the Gaussian should not be trusted (Yao et al. 2018). A Gaussian that is too
wide has no such tail; few of its draws then count, and what fraction is recorded too. Neither sees
another mode, where no draw is; so the modes that the optimiser's other starts ended in are compared
with the highest, and one that is nearly as high is recorded.
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
from scipy.optimize import minimize

from calibrate.arviz import array_stats
from calibrate.samplers.density import Density
from calibrate.samplers.options import check_counts
from calibrate.samplers.protocol import Context, Draws
from calibrate.statistical_model import Data
from emulator.errors import InputError, SolverError

_FEWEST = 25  # draws whose largest fifth has a tail to fit
_STEP = 1e-4  # of central differences of the gradient; coordinates are about 1 wide
_EQUAL = 1e-3  # log ratios closer together than this have no tail to fit
_AWAY = 0.05  # sd that the optimiser may stop from the mode
_RIVAL = 3.0  # nats below the highest mode; a mode of its width there has a twentieth of the mass
_APART = 4.0  # sd from the highest mode; the optimiser's stops are closer to their mode
_BARRIER = 1e30  # minus the log density where it is zero, for the optimiser


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
        if self.draws * self.chains < _FEWEST:
            raise InputError(
                f"{self.label}: {self.draws} draws of {self.chains} chains; give {_FEWEST} or more "
                "together, or its error cannot be estimated"
            )


class _Gaussian(NamedTuple):
    """Mode (p,), precision H (p, p), and by how much the next mode is lower, () nats."""

    mode: Any
    precision: Any
    rival: Any  # infinite where no other mode was found


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
        weighted by the ratios: 1 where the posterior is Gaussian. ``rival_mode``, where there is
        one, is by how much the log density of another mode is lower.

        Raises
        ------
        SolverError
            No mode was found, the density is flat there, or half of the Gaussian lies where it is
            zero.
        """
        programs = _compile(density)
        start_key, key = jax.random.split(jax.random.key(seed))
        empty = _Gaussian(np.zeros(density.dimension), np.zeros((density.dimension,) * 2), 0.0)
        gaussian = context.checkpoint.restore(lambda: empty)
        if gaussian is None:
            starts = programs.starts(jax.random.split(start_key, options.starts))
            modes, heights = _modes(programs, np.asarray(starts), data)
            precision = _precision(programs, modes[0], data)
            gaussian = _Gaussian(modes[0], precision, _rival(modes, heights, precision))
            context.checkpoint.keep(lambda: gaussian)
        z, lp, log_q = _draw(programs, gaussian, data, options, key)
        shape = (options.chains, options.draws)
        statistics = {"lp": lp.reshape(shape), "log_ratio": (lp - log_q).reshape(shape)}
        attributes = {
            "approximation": "gaussian",
            "pareto_k": pareto_k(lp - log_q),
            "importance_efficiency": efficiency(lp - log_q),
        }
        if np.isfinite(gaussian.rival):
            attributes["rival_mode"] = float(gaussian.rival)
        return Draws(z.reshape(*shape, -1), statistics, attributes)


class _Programs(NamedTuple):
    starts: Callable[..., Any]  # (keys (s,)) -> draws of the prior (s, p)
    value_and_gradient: Callable[..., Any]  # (z (p,), data) -> log density, gradient (p,)
    heights: Callable[..., Any]  # (z (s, p), data) -> log densities (s,)


@lru_cache(maxsize=4)
def _compile(density: Density) -> _Programs:
    return _Programs(
        jax.jit(jax.vmap(density.prior_draw)),
        jax.jit(jax.value_and_grad(density.log_density)),
        jax.jit(lambda z, data: jax.lax.map(lambda row: density.log_density(row, data), z)),
    )


def _modes(programs: _Programs, starts: np.ndarray, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Where L-BFGS ends from each start (s, p), and log densities there (s,); the highest first."""

    def negative(z: np.ndarray) -> tuple[float, np.ndarray]:
        height, slope = programs.value_and_gradient(jnp.asarray(z), data)
        if not (np.isfinite(height) and np.isfinite(slope).all()):
            return _BARRIER, np.zeros_like(z)
        return -float(height), -np.asarray(slope)

    tries = [
        minimize(negative, start, jac=True, method="L-BFGS-B", options={"ftol": 1e-12})
        for start in starts
    ]
    tries = sorted(tries, key=lambda found: found.fun)
    if not tries[0].fun < _BARRIER:
        raise SolverError("the posterior density is zero wherever the optimiser could start")
    return np.array([found.x for found in tries]), np.array([-found.fun for found in tries])


def _rival(modes: np.ndarray, heights: np.ndarray, precision: np.ndarray) -> float:
    """By how much the next mode is lower, in nats; infinite where no other is nearly as high."""
    steps = modes - modes[0]
    apart = np.einsum("si,ij,sj->s", steps, precision, steps) > _APART**2
    lower = (heights[0] - heights)[apart]
    return float(min((gap for gap in lower if gap < _RIVAL), default=np.inf))


def _precision(programs: _Programs, mode: np.ndarray, data: Data) -> np.ndarray:
    """Minus the Hessian of the log density, by central differences of its gradient.

    Forward maps that solve have a first derivative only.
    """

    def slope(z: np.ndarray) -> np.ndarray:
        return np.asarray(programs.value_and_gradient(jnp.asarray(z), data)[1])

    offsets = _STEP * np.eye(len(mode))
    hessian = np.array([slope(mode + d) - slope(mode - d) for d in offsets]) / (2.0 * _STEP)
    precision = -0.5 * (hessian + hessian.T)
    smallest = np.linalg.eigvalsh(precision)[0] if np.isfinite(precision).all() else np.nan
    if not smallest > 0.0:
        raise SolverError(
            f"the posterior has no curvature at its mode in some direction ({smallest:.2g}): it is "
            "flat there, or ends; use a sampler, such as nuts"
        )
    here = slope(mode)
    away = float(np.sqrt(here @ np.linalg.solve(precision, here)))
    if not away < _AWAY:
        raise SolverError(
            f"the optimiser stopped {away:.2g} sd from a mode: the posterior density ends or bends "
            "sharply there; use a sampler, such as nuts"
        )
    return precision


def _draw(
    programs: _Programs, gaussian: _Gaussian, data: Data, options: LaplaceOptions, key: jax.Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws (s, p), log densities and the Gaussian's, (s,); twice as many are tried."""
    wanted, size = options.chains * options.draws, len(gaussian.mode)
    noise = np.asarray(jax.random.normal(key, (2 * wanted, size)))
    # H = L L^T, so L^-T times white noise has covariance H^-1.
    factor = np.linalg.cholesky(gaussian.precision)
    z = gaussian.mode + solve_triangular(factor, noise.T, lower=True, trans="T").T
    lp = np.asarray(programs.heights(jnp.asarray(z), data))
    rows = np.flatnonzero(np.isfinite(lp))[:wanted]
    if len(rows) < wanted:
        raise SolverError(
            "half of the Gaussian at the mode lies where the posterior density is zero; use a "
            "sampler, such as nuts"
        )
    log_q = -0.5 * (noise**2).sum(axis=1) + np.log(np.diag(factor)).sum()
    return z[rows], lp[rows], log_q[rows] - 0.5 * size * np.log(2.0 * np.pi)


def pareto_k(log_ratios: np.ndarray) -> float:
    """Pareto shape of the tail of importance ratios (s,); 0 where they are equal to 0.1 %."""
    if np.ptp(log_ratios) < _EQUAL:
        return 0.0
    # ArviZ takes log likelihoods and negates them (docs/experiments.md, "A sign").
    return float(array_stats.psislw(-(log_ratios - log_ratios.max()))[1])


def efficiency(log_ratios: np.ndarray) -> float:
    """Effective sample size of importance ratios (s,), as a fraction: (sum w)^2 / (s sum w^2)."""
    weights = np.exp(log_ratios - log_ratios.max())
    return float(weights.sum() ** 2 / (len(weights) * (weights**2).sum()))


LAPLACE = Laplace()
