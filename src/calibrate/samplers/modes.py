r"""The modes of a posterior: where climbs end, their masses, and modes that draws have missed.

**Climbs.** An optimiser climbs the density from many starts. The Hessian where it ends,
:math:`H = -\nabla^2 \log p(\hat z \mid y)`, tells the mode's width, and Laplace's
approximation its mass. If :math:`f_1` modes were seen by one independent search and :math:`f_2` by
two, some :math:`f_1^2 / 2 f_2` were not seen at all (Chao 1984).

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

from collections.abc import Callable, Iterable, Sequence
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_triangular

from calibrate.statistical_model import Data
from calibrate.statistical_model.density import Density
from emulator.core.kept import kept
from emulator.core.minimise import minimise

# Attributes of a run: the log of the draws' mass over the missed mode's, infinite if none is
# missed; and the coordinates of the missed mode in words, if there is one.
MISSED_BY, MISSED_AT = "missed_mode_nats", "missed_mode"

BATCH, MOST = 12, 60  # starts of climbs at a time, and in all
MOST_BY_FEM = 8  # where each evaluation solves FEM
_MOST = 500  # iterations of the optimiser
_STEP = 1e-4  # step of central differences of the gradient; coordinates are about 1 wide
_AWAY = 0.3  # largest distance from the mode, in sd, at which the optimiser may stop
_SAME = 1.0  # distance, in sd, and difference in nats, below which two climbs ended at one mode
_NEGLIGIBLE = 7.0  # nats below the heaviest mode from which a mode is of no account
_LIGHT = 0.005  # share of all modes' mass below which it is no matter who saw a mode
_LIGHTER = 3.0  # nats by which a missed mode may be lighter than the draws: a twentieth
_BESIDE = 0.5  # distance to the nearest draw, in sd, below which a mode is not missed
_VALLEY = 2.0  # nats by which a valley is lower than both its ends
_ON_THE_WAY = 16  # points between mode and draw that are searched for a valley
_SAMPLE = 64  # draws from which the mean log density is computed


def coloured(noise: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Return white ``noise`` (s, p) with the covariance H^-1, where H = L L^T, L = ``factor``."""
    return solve_triangular(factor, noise.T, lower=True, trans="T").T


class _DensityPrograms(NamedTuple):
    """Compiled functions of a density.

    value_and_gradient : (z (p,), data) -> log density (), gradient (p,).
    climbing : the lock of a thread that climbs: one at a time, so that the gradient is compiled
        once.
    """

    value_and_gradient: Callable[..., Any]
    climbing: Lock


@kept
def programs_of(density: Density) -> _DensityPrograms:
    """Return the compiled functions of a density, which the density keeps."""
    return _DensityPrograms(jax.jit(jax.value_and_grad(density.log_density)), Lock())


def white_at_mode(
    density: Density, data: Data, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a mode (p,) and R (p, p) with ``R R^T = H^-1``; None where there is no such mode.

    starts : points (m, p) from which the optimiser starts.
    """
    ends = climb_from(density, data, starts)
    highest = _mode_at(density, data, ends.z[0], ends.heights[0]) if len(ends.z) else None
    return None if highest is None else (highest.z, highest.root)


class Ends(NamedTuple):
    """Points ``z`` (m, p) where climbs ended, and log densities (m,), the highest first."""

    z: Any
    heights: Any


def climb_from(
    density: Density, data: Data, starts: np.ndarray, draws: np.ndarray | None = None
) -> Ends:
    """Return the ends of L-BFGS from points ``starts`` (m, p); none where the density is zero.

    draws : draws (s, p) of the posterior, if there are any; in coordinates in which they are white
        the optimiser takes a few steps, where a sharp posterior takes thousands.
    """
    climb = _climber(density, data, draws)
    ends = [end for end in map(climb, starts) if np.isfinite(end[1])]
    ends = sorted(ends, key=lambda end: -end[1])
    z = np.array([point for point, _ in ends]).reshape(len(ends), density.dimension)
    return Ends(z, np.array([height for _, height in ends]))


def _climber(
    density: Density, data: Data, draws: np.ndarray | None
) -> Callable[..., tuple[np.ndarray, float]]:
    """Return the function from a start (p,) to the end of a climb and its log density.

    A climb that comes to one of the modes ``known`` ends there.
    """
    programs = programs_of(density)
    # The climb is in white coordinates w, with z = factor w.
    factor = np.eye(density.dimension)
    if draws is not None and (covariance := _covariance(draws)) is not None:
        factor = np.linalg.cholesky(covariance)

    def climb(start: np.ndarray, known: Sequence[Mode] = ()) -> tuple[np.ndarray, float]:
        def negative(w: np.ndarray) -> tuple[float, np.ndarray]:
            z = factor @ w
            height, slope = programs.value_and_gradient(jnp.asarray(z), data)
            for mode in known:
                if mode.is_at(z, float(height)):
                    raise _ArrivedError(mode)
            with np.errstate(invalid="ignore"):  # far away, where the slope is not finite
                return -float(height), -(np.asarray(slope) @ factor)

        w = np.linalg.solve(factor, start)
        try:
            end = minimise(negative, w, iterations=_MOST, tolerance=1e-12)
        except _ArrivedError as arrived:
            return arrived.mode.z, arrived.mode.height
        return factor @ end.x, -end.value

    return climb


class _ArrivedError(Exception):
    """A climb came to a mode that is known."""

    def __init__(self, mode: Mode) -> None:
        super().__init__()
        self.mode = mode


class Mode(NamedTuple):
    """A mode that climbs ended at.

    z : its place, (p,). height : the log density there.
    factor : the Cholesky factor L (p, p) of the precision, H = L L^T.
    log_mass : the logarithm of Laplace's mass.
    climbs : the number of climbs that ended there.
    """

    z: np.ndarray
    height: float
    factor: np.ndarray
    log_mass: float
    climbs: int = 1

    def distances(self, z: np.ndarray) -> np.ndarray:
        """Return the squared distances (s,) of points z (s, p), in sd of the mode."""
        return (((z - self.z) @ self.factor) ** 2).sum(axis=1)

    @property
    def root(self) -> np.ndarray:
        """The factor R (p, p) of the covariance, H^-1 = R R^T."""
        return coloured(np.eye(len(self.z)), self.factor).T

    def is_at(self, z: np.ndarray, height: float) -> bool:
        """Return whether a climb that ended at z (p,) ended at this mode."""
        return abs(height - self.height) < _SAME and self.distances(z[None])[0] < _SAME**2


def merged(modes: Iterable[Mode]) -> list[Mode]:
    """Return every mode once, the heaviest first, with the number of all its climbs."""
    distinct: list[Mode] = []
    for mode in modes:
        for k, other in enumerate(distinct):
            if other.is_at(mode.z, mode.height):
                distinct[k] = other._replace(climbs=other.climbs + mode.climbs)
                break
        else:
            distinct.append(mode)
    return sorted(distinct, key=lambda mode: -mode.log_mass)


def of_account(modes: Sequence[Mode]) -> list[Mode]:
    """Return the modes of at least a thousandth of the mass of the first, the heaviest."""
    return [mode for mode in modes if mode.log_mass > modes[0].log_mass - _NEGLIGIBLE]


def shares(modes: Sequence[Mode]) -> np.ndarray:
    """Return the shares (m,) of the modes in their mass, the first being the heaviest."""
    masses = np.exp([mode.log_mass - modes[0].log_mass for mode in modes])
    return masses / max(masses.sum(), 1.0)


def heavy(modes: Sequence[Mode]) -> list[Mode]:
    """Return the modes of half a percent of the mass or more."""
    return [mode for mode, share in zip(modes, shares(modes), strict=True) if share >= _LIGHT]


def explore(
    density: Density, data: Data, starts: np.ndarray, draws: np.ndarray | None = None
) -> list[Mode]:
    """Return the modes that climbs from ``starts`` (m, p) end at, the heaviest first.

    All climb where there are several modes of account: where the first batch ended at one, none of
    the others does. Ends that are no modes, as on a flat ridge, are left out.

    draws : as of :func:`climb_from`.
    """
    climb, modes = _climber(density, data, draws), list[Mode]()
    for number, start in enumerate(starts):
        if number == BATCH and len(of_account(modes)) < 2:
            break
        z, height = climb(start, modes)
        known = next((k for k, mode in enumerate(modes) if mode.is_at(z, height)), None)
        if known is not None:
            modes[known] = modes[known]._replace(climbs=modes[known].climbs + 1)
        elif np.isfinite(height) and (mode := _mode_at(density, data, z, height)) is not None:
            modes = merged([*modes, mode])
    return modes


def modes_at(density: Density, data: Data, ends: Ends) -> list[Mode]:
    """Return every mode at which climbs ended once, the heaviest first."""
    modes = (_mode_at(density, data, z, height) for z, height in zip(*ends, strict=True))
    return merged(mode for mode in modes if mode is not None)


def _mode_at(density: Density, data: Data, z: np.ndarray, height: float) -> Mode | None:
    """Return the mode at z (p,), or None where a climb ended elsewhere."""
    precision, smallest, distance = curvature(density, data, z)
    if not (smallest > 0.0 and distance < _AWAY):
        return None
    factor = np.linalg.cholesky(precision)
    log_mass = height + 0.5 * len(z) * np.log(2.0 * np.pi) - np.log(np.diag(factor)).sum()
    return Mode(z, float(height), factor, float(log_mass))


def unseen(counts: Sequence[int]) -> float:
    """Return Chao's estimate of the number of modes that were never seen.

    counts : the number of times that each mode was seen.
    """
    once, twice = (sum(count == k for count in counts) for k in (1, 2))
    return 0.5 * once**2 / twice if twice else 0.5 * once * (once - 1)


def missed_mode(
    density: Density, data: Data, z: np.ndarray, modes: Sequence[Mode]
) -> dict[str, Any]:
    """Return attributes of a run with draws ``z`` (s, p): the heaviest of ``modes`` missed."""
    program = programs_of(density).value_and_gradient

    def height(point: np.ndarray) -> float:
        value = float(program(jnp.asarray(point), data)[0])
        return value if np.isfinite(value) else -np.inf

    attributes: dict[str, Any] = {MISSED_BY: np.inf}
    covariance = _covariance(z)
    if not modes or covariance is None:
        return attributes
    log_det = np.linalg.slogdet(covariance)[1]
    whitener = np.linalg.cholesky(np.linalg.inv(covariance))
    some = z[np.linspace(0, len(z) - 1, min(_SAMPLE, len(z))).astype(int)]
    log_mass_of_draws = np.mean([height(point) for point in some])
    log_mass_of_draws += 0.5 * (len(covariance) * (1.0 + np.log(2.0 * np.pi)) + log_det)
    for mode in modes:
        distances = (((z - mode.z) @ whitener) ** 2).sum(axis=1)
        if distances.min() < _BESIDE**2:
            continue
        nearest = z[np.argmin(distances)]
        way = np.linspace(0.0, 1.0, _ON_THE_WAY + 2)[1:-1, None]
        lowest = min(height(point) for point in mode.z + way * (nearest - mode.z))
        if not lowest < min(mode.height, height(nearest)) - _VALLEY:
            continue
        lighter = float(log_mass_of_draws - mode.log_mass)
        if lighter < min(attributes[MISSED_BY], _LIGHTER):
            named = density.constrain(jnp.asarray(mode.z)[None])
            words = ", ".join(f"{name} {float(value[0]):.4g}" for name, value in named.items())
            attributes = {MISSED_BY: lighter, MISSED_AT: words}
    return attributes


def _covariance(draws: np.ndarray) -> np.ndarray | None:
    """Return the covariance (p, p) of draws (s, p), unless they do not vary in some direction."""
    covariance = np.atleast_2d(np.cov(draws, rowvar=False))
    if not np.isfinite(covariance).all() or not np.linalg.eigvalsh(covariance)[0] > 0.0:
        return None
    return covariance


def curvature(density: Density, data: Data, z: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return minus the Hessian (p, p), its smallest eigenvalue, and the distance to a mode.

    The Hessian is by central differences of the gradient, because forward maps that solve have a
    first derivative only. The distance is in sd; it is NaN where the Hessian is not definite.
    """
    program = programs_of(density).value_and_gradient

    def slope(z: np.ndarray) -> np.ndarray:
        return np.asarray(program(jnp.asarray(z), data)[1])

    offsets = _STEP * np.eye(len(z))
    hessian = np.array([slope(z + d) - slope(z - d) for d in offsets]) / (2.0 * _STEP)
    precision = -0.5 * (hessian + hessian.T)
    if not np.isfinite(precision).all():
        return precision, np.nan, np.nan
    values, vectors = np.linalg.eigh(precision)
    smallest = float(values[0])
    # An eigenvalue below the round-off of the largest one says nothing of the curvature.
    if not smallest > len(z) * np.finfo(float).eps * values[-1]:
        return precision, min(smallest, 0.0), np.nan
    return precision, smallest, float(np.linalg.norm(slope(z) @ vectors / np.sqrt(values)))
