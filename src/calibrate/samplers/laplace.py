r"""The modes of a posterior: the Laplace approximation there, and modes that draws have missed.

**The Laplace approximation** is a Gaussian at the mode, in unconstrained coordinates,

.. math:: z \sim \mathcal{N}\!\left(\hat z, H^{-1}\right), \qquad
          H = -\nabla^2 \log p(\hat z \mid y)

(Gelman et al. 2013, Sec. 4.1, 13.3). Draws are independent, so R-hat and effective sample size say
nothing of the error. The ratios :math:`p(z \mid y) / q(z)` do: the Pareto shape k of their tail is
recorded, and above 0.7 the Gaussian should not be trusted (Yao et al. 2018). A Gaussian that is too
wide has no such tail; few of its draws then count, and their fraction is recorded too. Neither sees
another mode, where no draw is.

**A missed mode.** Chains that start beside the same of two modes agree with each other: R-hat sees
nothing. So an optimiser starts at draws of the prior, and a mode in which it ends counts as missed
if

- a valley lies before it: on the way to the nearest draw the log density falls below both ends;
- its mass counts. The mass at a mode is Laplace's, :math:`\log p(\hat z) + \tfrac{d}{2} \log 2\pi -
  \tfrac12 \log\det H`, against that of the draws, :math:`\log Z = \mathrm{E}[\log p] +
  \mathrm{H}[p] \le \mathrm{E}[\log p] + \tfrac12 \log\det (2\pi e \Sigma)`, as no density of
  covariance :math:`\Sigma` has more entropy than the Gaussian.

A funnel's neck is high and far from all draws, but no valley lies before it. Because of the bound
the test is conservative: draws on a bent ridge look heavier than they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_triangular

from calibrate.samplers.density import Density, prior_draws
from calibrate.samplers.diagnostics import FEWEST_WEIGHTS, effective, normalised, pareto_shape
from calibrate.samplers.protocol import Context, Draws, Options, Sampler
from calibrate.statistical_model import Data
from emulator.core.errors import InputError, SolverError
from emulator.core.minimise import minimise

# Attributes of a run: the log of the draws' mass over the missed mode's, infinite if none is
# missed; and the coordinates of the missed mode in words, if there is one.
MISSED_BY, MISSED_AT = "missed_mode_nats", "missed_mode"

STARTS = 8  # draws of the prior from which modes are searched
_MOST = 500  # iterations of the optimiser
_STEP = 1e-4  # step of central differences of the gradient; coordinates are about 1 wide
_AWAY = 0.05  # largest distance from the mode, in sd, at which the optimiser may stop
_AWAY_OF_MASS = 0.3  # the same limit where only a mode's mass is computed, or draws are beside it
_LIGHTER = 3.0  # nats by which a missed mode may be lighter than the draws: a twentieth
_BESIDE = 0.5  # distance to the nearest draw, in sd, below which a mode is not missed
_VALLEY = 2.0  # nats by which a valley is lower than both its ends
_ON_THE_WAY = 16  # points between mode and draw that are searched for a valley
_SAMPLE = 64  # draws from which the mean log density is computed


@dataclass(frozen=True)
class LaplaceOptions(Options):
    """Size of a run.

    draws, chains : the number of independent draws of a set, and of sets.
    starts : the number of draws of the prior that the optimiser starts from; the highest mode is
        taken.
    """

    draws: int = 1000
    chains: int = 4
    starts: int = STARTS

    label: ClassVar[str] = "Laplace"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.draws * self.chains < FEWEST_WEIGHTS:
            raise InputError(
                f"{self.label}: {self.draws} draws of {self.chains} chains; give {FEWEST_WEIGHTS} "
                "or more together, or its error cannot be estimated"
            )


class _Gaussian(NamedTuple):
    """Mode (p,), precision H (p, p), and all modes, the highest first."""

    mode: Any
    precision: Any
    modes: Any


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
        template = _Gaussian(number, number, Modes(number, number))
        gaussian = context.checkpoint.restore(lambda: template)
        if gaussian is None:
            modes = find_modes(density, data, prior_draws(density, start_key, options.starts))
            if not len(modes.z):
                raise SolverError(
                    "the posterior density is zero wherever the optimiser could start"
                )
            precision, smallest, distance = _curvature(density, data, modes.z[0])
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
            gaussian = _Gaussian(modes.z[0], precision, modes)
            context.checkpoint.keep(lambda: gaussian)
        z, lp, log_q = _draw(density, gaussian, data, options, key)
        shape = (options.chains, options.draws)
        statistics = {"lp": lp.reshape(shape), "log_ratio": (lp - log_q).reshape(shape)}
        attributes = {
            "approximation": "gaussian",
            "pareto_k": pareto_shape(lp - log_q),
            "importance_efficiency": effective(normalised(lp - log_q)) / len(lp),
            **missed_mode(density, data, z, gaussian.modes),
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
    z = gaussian.mode + _coloured(noise, factor)
    lp = np.asarray(_compile(density).heights(jnp.asarray(z), data))
    rows = np.flatnonzero(np.isfinite(lp))[:count]
    if len(rows) < count:
        raise SolverError(
            "half of the Gaussian at the mode lies where the posterior density is zero; use a "
            "sampler, such as nuts"
        )
    log_q = -0.5 * (noise**2).sum(axis=1) + np.log(np.diag(factor)).sum()
    return z[rows], lp[rows], log_q[rows] - 0.5 * size * np.log(2.0 * np.pi)


def _coloured(noise: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Return white ``noise`` (s, p) with the covariance H^-1, where H = L L^T, L = ``factor``."""
    return solve_triangular(factor, noise.T, lower=True, trans="T").T


class _Programs(NamedTuple):
    """Compiled functions of a density.

    value_and_gradient : (z (p,), data) -> log density (), gradient (p,).
    heights : (z (s, p), data) -> log densities (s,).
    """

    value_and_gradient: Callable[..., Any]
    heights: Callable[..., Any]


@lru_cache(maxsize=4)
def _compile(density: Density) -> _Programs:
    return _Programs(
        jax.jit(jax.value_and_grad(density.log_density)),
        jax.jit(lambda z, data: jax.lax.map(lambda row: density.log_density(row, data), z)),
    )


def white_at_mode(
    density: Density, data: Data, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a mode (p,) and R (p, p) with ``R R^T = H^-1``; None where there is no such mode.

    starts : points (m, p) from which the optimiser starts.
    """
    modes = find_modes(density, data, starts)
    if not len(modes.z):
        return None
    precision, smallest, distance = _curvature(density, data, modes.z[0])
    if not (smallest > 0.0 and distance < _AWAY_OF_MASS):
        return None
    factor = np.linalg.cholesky(precision)
    return modes.z[0], _coloured(np.eye(len(factor)), factor).T


class Modes(NamedTuple):
    """Points ``z`` (m, p) where the optimiser ended, and log densities (m,), the highest first."""

    z: Any
    heights: Any


def find_modes(
    density: Density, data: Data, starts: np.ndarray, draws: np.ndarray | None = None
) -> Modes:
    """Return where L-BFGS ends from points ``starts`` (m, p); none where the density is zero.

    draws : draws (s, p) of the posterior, if there are any; in coordinates in which they are white
        the optimiser takes a few steps, where a sharp posterior takes thousands.
    """
    programs = _compile(density)
    # From white coordinates w to z = factor w.
    factor = np.eye(density.dimension)
    if draws is not None and (covariance := _covariance(draws)) is not None:
        factor = np.linalg.cholesky(covariance)

    def negative(w: np.ndarray) -> tuple[float, np.ndarray]:
        height, slope = programs.value_and_gradient(jnp.asarray(factor @ w), data)
        with np.errstate(invalid="ignore"):  # far away, where the slope is not finite
            return -float(height), -(np.asarray(slope) @ factor)

    minima = [
        minimise(negative, np.linalg.solve(factor, start), iterations=_MOST, tolerance=1e-12)
        for start in starts
    ]
    minima = sorted((m for m in minima if np.isfinite(m.value)), key=lambda m: m.value)
    z = np.array([factor @ m.x for m in minima]).reshape(len(minima), density.dimension)
    return Modes(z, np.array([-m.value for m in minima]))


def draws_beside(
    density: Density, data: Data, modes: Modes, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return ``count`` draws z (s, p) of the Gaussian at each mode; none where there is none."""
    draws = [np.zeros((0, density.dimension))]
    for mode in modes.z:
        precision, smallest, distance = _curvature(density, data, mode)
        if smallest > 0.0 and distance < _AWAY_OF_MASS:
            noise = rng.normal(size=(count, len(mode)))
            draws.append(mode + _coloured(noise, np.linalg.cholesky(precision)))
    return np.concatenate(draws)


def missed_mode(density: Density, data: Data, z: np.ndarray, modes: Modes) -> dict[str, Any]:
    """Return attributes of a run with draws ``z`` (s, p): the heaviest of ``modes`` missed."""
    program = _compile(density).value_and_gradient

    def height(point: np.ndarray) -> float:
        value = float(program(jnp.asarray(point), data)[0])
        return value if np.isfinite(value) else -np.inf

    attributes: dict[str, Any] = {MISSED_BY: np.inf}
    covariance = _covariance(z)
    if len(modes.z) == 0 or covariance is None:
        return attributes
    log_det = np.linalg.slogdet(covariance)[1]
    whitener = np.linalg.cholesky(np.linalg.inv(covariance))
    some = z[np.linspace(0, len(z) - 1, min(_SAMPLE, len(z))).astype(int)]
    log_mass_of_draws = np.mean([height(each) for each in some])
    log_mass_of_draws += 0.5 * (len(covariance) * (1.0 + np.log(2.0 * np.pi)) + log_det)
    for mode, top in zip(*modes, strict=True):
        distances = (((z - mode) @ whitener) ** 2).sum(axis=1)
        if distances.min() < _BESIDE**2:
            continue
        nearest = z[np.argmin(distances)]
        way = np.linspace(0.0, 1.0, _ON_THE_WAY + 2)[1:-1, None]
        lowest = min(height(each) for each in mode + way * (nearest - mode))
        if not lowest < min(top, height(nearest)) - _VALLEY:
            continue
        precision, smallest, distance = _curvature(density, data, mode)
        if not (smallest > 0.0 and distance < _AWAY_OF_MASS):  # flat there, or no mode
            continue
        log_mass = top + 0.5 * (len(mode) * np.log(2.0 * np.pi) - np.linalg.slogdet(precision)[1])
        lighter = float(log_mass_of_draws - log_mass)
        if lighter < min(attributes[MISSED_BY], _LIGHTER):
            named = density.constrain(jnp.asarray(mode)[None])
            words = ", ".join(f"{name} {float(value[0]):.4g}" for name, value in named.items())
            attributes = {MISSED_BY: lighter, MISSED_AT: words}
    return attributes


def _covariance(draws: np.ndarray) -> np.ndarray | None:
    """Return the covariance (p, p) of draws (s, p), unless they do not vary in some direction."""
    covariance = np.atleast_2d(np.cov(draws, rowvar=False))
    if not np.isfinite(covariance).all() or not np.linalg.eigvalsh(covariance)[0] > 0.0:
        return None
    return covariance


def _curvature(density: Density, data: Data, z: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return minus the Hessian (p, p), its smallest eigenvalue, and the distance to a mode.

    The Hessian is by central differences of the gradient, because forward maps that solve have a
    first derivative only. The distance is in sd; it is NaN where the Hessian is not definite.
    """
    program = _compile(density).value_and_gradient

    def slope(z: np.ndarray) -> np.ndarray:
        return np.asarray(program(jnp.asarray(z), data)[1])

    offsets = _STEP * np.eye(len(z))
    hessian = np.array([slope(z + d) - slope(z - d) for d in offsets]) / (2.0 * _STEP)
    precision = -0.5 * (hessian + hessian.T)
    if not np.isfinite(precision).all():
        return precision, np.nan, np.nan
    smallest = float(np.linalg.eigvalsh(precision)[0])
    if not smallest > 0.0:
        return precision, smallest, np.nan
    gradient = slope(z)
    return precision, smallest, float(np.sqrt(gradient @ np.linalg.solve(precision, gradient)))
