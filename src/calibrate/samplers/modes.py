r"""Modes of the posterior that draws have missed.

Chains that start beside the same of two modes agree with each other: R-hat sees nothing. So an
optimiser climbs from draws of the prior, and a mode that it ends in is reported as missed if

- a valley lies before it: on the way to the nearest draw the log density falls below both ends;
- its mass counts. The mass beside a mode is Laplace's, :math:`\log p(\hat z) + \tfrac{d}{2} \log
  2\pi - \tfrac12 \log\det H` with :math:`H = -\nabla^2 \log p(\hat z)`, against that of the draws,
  :math:`\log Z = \mathrm{E}[\log p] + \mathrm{H}[p] \le \mathrm{E}[\log p] + \tfrac12 \log\det
  (2\pi e \Sigma)`, as no density of covariance :math:`\Sigma` has more entropy than the Gaussian.

A funnel's neck is high and far from all draws, but no valley lies before it. The bound makes the
test careful: draws on a bent ridge look heavier than they are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from calibrate.samplers.density import Density
from calibrate.statistical_model import Data

# Attributes of a run: log of the draws' mass over the missed mode's, infinite where none is missed;
# only where one is, its place in words.
MISSED_BY, MISSED_AT = "missed_mode_nats", "missed_mode"

_STARTS = 8  # draws of the prior
_MOST = 500  # iterations of the optimiser
_AWAY = 0.3  # sd that it may stop from a mode
_STEP = 1e-4  # of central differences of the gradient; coordinates are about 1 wide
_BARRIER = 1e30  # minus the log density where it is zero, for the optimiser
_LIGHTER = 3.0  # nats: a mode of a twentieth of the draws' mass
_BESIDE = 0.5  # sd from the nearest draw: not missed
_VALLEY = 2.0  # nats below both ends
_ON_THE_WAY = 16  # points between mode and draw
_SAMPLE = 64  # draws that the mean log density is of


class Programs(NamedTuple):
    """Compiled functions of a density.

    starts : (keys (s,)) -> draws of the prior (s, p).
    value_and_gradient : (z (p,), data) -> log density (), gradient (p,).
    """

    starts: Callable[..., Any]
    value_and_gradient: Callable[..., Any]


@lru_cache(maxsize=4)
def compile_programs(density: Density) -> Programs:
    """The programs that a search needs; compiled at their first call."""
    return Programs(
        jax.jit(jax.vmap(density.prior_draw)),
        jax.jit(jax.value_and_grad(density.log_density)),
    )


class Modes(NamedTuple):
    """Where the optimiser ended, ``z`` (m, p), and log densities there (m,); the highest first."""

    z: Any
    heights: Any


def find_modes(
    density: Density,
    data: Data,
    key: jax.Array,
    starts: int = _STARTS,
    draws: np.ndarray | None = None,
) -> Modes:
    """Where L-BFGS ends from ``starts`` draws of the prior; none where the density is zero.

    draws : (s, p) of the posterior, if there are; in coordinates where they are white it takes a
        few steps, where a sharp posterior takes thousands.
    """
    programs = compile_programs(density)
    # From white coordinates w to z = factor w.
    factor = np.eye(density.dimension)
    if draws is not None and (found := _spread(draws)) is not None:
        factor = np.linalg.cholesky(found)

    def negative(w: np.ndarray) -> tuple[float, np.ndarray]:
        height, slope = programs.value_and_gradient(jnp.asarray(factor @ w), data)
        if not (np.isfinite(height) and np.isfinite(slope).all()):
            return _BARRIER, np.zeros_like(w)
        return -float(height), -(np.asarray(slope) @ factor)

    begun = np.asarray(programs.starts(jax.random.split(key, starts)))
    tries = [
        minimize(
            negative,
            np.linalg.solve(factor, start),
            jac=True,
            method="L-BFGS-B",
            options={"ftol": 1e-12, "maxiter": _MOST},
        )
        for start in begun
    ]
    ended = sorted((each for each in tries if each.fun < _BARRIER), key=lambda each: each.fun)
    z = np.array([factor @ each.x for each in ended]).reshape(len(ended), density.dimension)
    return Modes(z, np.array([-each.fun for each in ended]))


def _spread(draws: np.ndarray) -> np.ndarray | None:
    """Covariance (p, p) of draws (s, p); ``None`` where they do not vary in some direction."""
    covariance = np.atleast_2d(np.cov(draws, rowvar=False))
    if not np.isfinite(covariance).all() or not np.linalg.eigvalsh(covariance)[0] > 0.0:
        return None
    return covariance


def precision_at(density: Density, data: Data, z: np.ndarray) -> np.ndarray:
    """Minus the Hessian of the log density (p, p), by central differences of its gradient.

    Forward maps that solve have a first derivative only.
    """
    slope = slope_of(density, data)
    offsets = _STEP * np.eye(len(z))
    hessian = np.array([slope(z + d) - slope(z - d) for d in offsets]) / (2.0 * _STEP)
    return -0.5 * (hessian + hessian.T)


def slope_of(density: Density, data: Data) -> Callable[[np.ndarray], np.ndarray]:
    """The gradient of the log density, (p,) -> (p,)."""
    program = compile_programs(density).value_and_gradient
    return lambda z: np.asarray(program(jnp.asarray(z), data)[1])


def missed_mode(density: Density, data: Data, z: np.ndarray, modes: Modes) -> dict[str, Any]:
    """Attributes of a run with draws ``z`` (s, p): the heaviest of ``modes`` that they missed."""
    program = compile_programs(density).value_and_gradient

    def height(point: np.ndarray) -> float:
        value = float(program(jnp.asarray(point), data)[0])
        return value if np.isfinite(value) else -np.inf

    found: dict[str, Any] = {MISSED_BY: np.inf}
    covariance = _spread(z)
    if len(modes.z) == 0 or covariance is None:
        return found
    log_det = np.linalg.slogdet(covariance)[1]
    whitener = np.linalg.cholesky(np.linalg.inv(covariance))
    some = z[np.linspace(0, len(z) - 1, min(_SAMPLE, len(z))).astype(int)]
    drawn = np.mean([height(each) for each in some])
    drawn += 0.5 * (len(covariance) * (1.0 + np.log(2.0 * np.pi)) + log_det)
    for mode, top in zip(*modes, strict=True):
        distances = (((z - mode) @ whitener) ** 2).sum(axis=1)
        if distances.min() < _BESIDE**2:
            continue
        nearest = z[np.argmin(distances)]
        way = np.linspace(0.0, 1.0, _ON_THE_WAY + 2)[1:-1, None]
        lowest = min(height(each) for each in mode + way * (nearest - mode))
        if not lowest < min(top, height(nearest)) - _VALLEY:
            continue
        lighter = float(drawn - _mass(density, data, mode, top))
        if lighter < min(found[MISSED_BY], _LIGHTER):
            found = {MISSED_BY: lighter, MISSED_AT: _place(density, mode)}
    return found


def _place(density: Density, z: np.ndarray) -> str:
    named = density.constrain(jnp.asarray(z)[None])
    return ", ".join(f"{name} {float(value[0]):.4g}" for name, value in named.items())


def _mass(density: Density, data: Data, mode: np.ndarray, top: float) -> float:
    """Log of Laplace's mass beside a mode; none where it is flat, or the optimiser stopped away."""
    precision = precision_at(density, data, mode)
    if not np.isfinite(precision).all() or not np.linalg.eigvalsh(precision)[0] > 0.0:
        return -np.inf
    slope = slope_of(density, data)(mode)
    if not slope @ np.linalg.solve(precision, slope) < _AWAY**2:
        return -np.inf
    log_det = np.linalg.slogdet(precision)[1]
    return float(top + 0.5 * (len(mode) * np.log(2.0 * np.pi) - log_det))
