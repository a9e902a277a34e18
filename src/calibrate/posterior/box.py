r"""Detection of posteriors that end at the ends of a box prior instead of by the data.

A parameter without a prior has its scene's range as one, a box. Often that range is a guess. Where
the data want more than it allows, draws gather at its end, closer together than the data alone
would have them: their sd says how near the end is, not what is known.

Draws :math:`x_i` of the parameters with a box are taken as positions in it, 0 to 1 on each
parameter's scale. The line through :math:`x_i` along a unit vector :math:`d` leaves the box after
the distance :math:`t_i`: along an axis at the end of that range, along others also in a corner,
where several ranges end together. Near the exit the distances have the density

.. math:: p(t) \propto e^{-\alpha t - \beta t^2}, \qquad 0 \le t \le T

with :math:`T` their 90 % quantile and :math:`\alpha, \beta` of maximum likelihood. Continued
outwards, to :math:`t = -E`, it gives the mass beyond the exit, relative to that of the draws,

.. math:: M = p(0) \int_0^E e^{\alpha r - \max(\beta, 0)\, r^2}\, dr .

The masses beyond both exits have their centres :math:`m_\pm` along :math:`d`, on from where draws
*at* the exit stand (not where most lines end: across a thin posterior those end far from any draw).
In a wider box the mean would move by

.. math:: \Delta = \frac{M_+ (m_+ - \bar x) + M_- (m_- - \bar x)}{1 + M_+ + M_-}

where :math:`E` is three sd of the draws along :math:`d`, or less where nature ends. Where far
fewer draws are at the exit than the fit says, as between separate modes and an end, the end is
none. The directions are the axes and the principal axes of the draws. A posterior that is about as
wide as the box along :math:`d` is left open by the data; it claims nothing there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from calibrate.state_names import split
from emulator.core.machine import one_blas_thread
from emulator.core.minimise import minimise
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.parameter_space import AT_LIMIT, Parameter

LARGEST_SHIFT = 0.5  # posterior sd by which a wider box may move a mean: as for a finer mesh
_NO_LIMITS = Quantity("", low=-np.inf)
_OPEN = 0.8  # posterior sd over the box's, above which the data leave a direction open
_NEAR = 0.9  # quantile of the distances up to which their density is fitted
_FAR = 3.0  # posterior sd to which a density is continued, and the largest shift that is meant
_OFTEN = 0.1  # share of the draws nearest to the exit that leave at an end which is named
_AT, _TOO_MANY = 10, 3.0  # draws at the exit, and how many times as many the fit may say there are
_STEEPEST = 50.0  # slope and curvature of the fitted log density, in units of 1 / T
_NODES, _WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(48))  # on -1/2 to 1/2
_NODES += 0.5


@dataclass(frozen=True)
class BoxEnd:
    """One end of a parameter's range that ends the posterior.

    name : the unknown. value : the end of its range. unit : the unit of both.
    shift : the change of the mean by a wider box, in posterior sd, at most 3.
    """

    name: str
    value: float
    unit: str
    shift: float

    def __str__(self) -> str:
        """Return the end in words, such as ``a_f at 10.3 kPa``."""
        return f"{self.name} at {self.value:.4g} {self.unit}".rstrip()


@one_blas_thread()
def box_ends(
    draws: Mapping[str, np.ndarray],
    box: Mapping[str, Parameter],
    quantities: Mapping[str, Quantity] = {},
) -> list[BoxEnd]:
    """Return the ends of ranges that end the posterior in place of the data, the worst first.

    Parameters
    ----------
    draws : the draws (s,) of each unknown. box : the range of each unknown whose prior is a box.
    quantities : the limits of each parameter's values by nature, by its name.
    """
    names = [n for n in box if np.ptp(draws[n]) > 0.0]
    if not names:
        return []
    x = np.stack([box[n].to_unit(jnp.ravel(draws[n])) for n in names], axis=1)
    x = np.clip(x, 0.0, 1.0)
    beyond = np.array([_beyond(box[n], quantities.get(box[n].name, _NO_LIMITS)) for n in names]).T
    covariance = np.atleast_2d(np.cov(x, rowvar=False))
    directions = np.vstack([np.eye(len(names)), np.linalg.eigh(covariance)[1].T])
    worst: dict[tuple[int, bool], float] = {}
    for d in directions:
        sd = float(np.sqrt(d @ covariance @ d))
        if not 0.0 < sd < _OPEN * np.sqrt((d**2).sum() / 12.0):
            continue
        up, down = (_exit(x, direction, beyond, _FAR * sd) for direction in (d, -d))
        shift = (up.mass * up.beyond - down.mass * down.beyond) / (1.0 + up.mass + down.mass)
        if abs(shift) <= LARGEST_SHIFT * sd:
            continue
        for end in (up if shift > 0.0 else down).ends:
            worst[end] = max(worst.get(end, 0.0), min(abs(shift) / sd, _FAR))
    ends = []
    for (k, at_high), shift in sorted(worst.items(), key=lambda item: -item[1]):
        parameter = box[names[k]]
        value = parameter.high if at_high else parameter.low
        ends.append(BoxEnd(names[k], value, parameter.unit, shift))
    return ends


@dataclass(frozen=True)
class _Exit:
    """The mass that a wider box would hold beyond one exit.

    mass : the mass relative to the draws'. beyond : the distance of its centre from their mean.
    ends : the parameters' numbers, and whether it is their upper end, at which draws leave the box.
    """

    mass: float
    beyond: float
    ends: tuple[tuple[int, bool], ...]


def in_words(ends: Sequence[BoxEnd]) -> tuple[str, str]:
    """Return a sentence on the effect of these ends on the posterior, and its remedy."""
    shift = max(end.shift for end in ends)
    by = f"{shift:.1f} sd" if shift < 0.9 * _FAR else f"about {_FAR:.0f} sd or more"
    # Without the load state, pressure@p8, and without the member of a population, mu[beam1].
    names = " ".join(dict.fromkeys(split(end.name)[0].split("[")[0] for end in ends))
    corner = "a corner of the box ends" if len(ends) > 1 else "the box ends"
    return (
        f"{corner} the posterior, not the data: {', '.join(map(str, ends))}; in a wider one means "
        f"would move by {by}",
        "infer without a box (a mesh: --forward rounds), or give a wider range or a prior, or say "
        f"that nature ends there (--bounded {names})",
    )


def _beyond(parameter: Parameter, quantity: Quantity) -> tuple[float, float]:
    """Return how far below and above its range a parameter's values may be by nature.

    In ranges, on its scale; zero where an end is at such a limit. A range above zero ends there.
    """
    low, high = parameter.low, parameter.high
    least = max(quantity.low, 0.0) if low >= 0.0 else quantity.low
    near = AT_LIMIT * (high - low)
    if parameter.scale == "log":
        span = np.log(high / low)
        below = float(np.log(low / least) / span) if least > 0.0 else np.inf
        above = float(np.log(quantity.high / high) / span)
    else:
        below = 0.0 if low - least < near else (low - least) / (high - low)
        above = (quantity.high - high) / (high - low)
    return below, 0.0 if quantity.high - high < near else above


def _exit(x: np.ndarray, d: np.ndarray, beyond: np.ndarray, farthest: float) -> _Exit:
    """Return the mass beyond the box along ``d`` (q,) from positions x (s, q).

    beyond : how far each lower and each upper side may move out, (2, q). farthest : at most.
    """
    moves = np.abs(d) > 1e-9
    d, x = d[moves], x[:, moves]
    high = d > 0.0
    gap = np.where(high, 1.0 - x, x) / np.abs(d)
    first = gap.argmin(axis=1)
    t = gap[np.arange(len(x)), first]
    extent = np.where(high, beyond[1, moves], beyond[0, moves]) / np.abs(d)
    E = min(float(np.median((gap + extent).min(axis=1) - t)), farthest)
    T = float(np.quantile(t, _NEAR))
    if not (T > 0.0 and E > 0.0):
        return _Exit(0.0, 0.0, ())
    log_norm, alpha, beta = _fit(t[t <= T] / T)
    count = min(max(_AT, len(t) // 1000), len(t))
    edge = float(np.partition(t, count - 1)[count - 1]) / T
    density = np.exp(-alpha * edge * _NODES - beta * (edge * _NODES) ** 2 - log_norm)
    if len(t) * _NEAR * edge * float(_WEIGHTS @ density) > _TOO_MANY * count:
        return _Exit(0.0, 0.0, ())
    r = E / T * _NODES
    outside = np.exp(np.minimum(alpha * r - max(beta, 0.0) * r**2 - log_norm, _STEEPEST))
    outside *= _WEIGHTS * E / T * _NEAR
    mass = float(outside.sum())
    near = t <= np.quantile(t, 1.0 - _NEAR)
    share = np.bincount(first[near], minlength=len(d)) / near.sum()
    numbers = np.flatnonzero(moves)
    ends = tuple((int(numbers[k]), bool(high[k])) for k in np.flatnonzero(share >= _OFTEN))
    # A line through positions over distances says, at distance 0, where draws at the exit stand.
    position = x @ d
    t_near, p_near = t[near] - t[near].mean(), position[near]
    slope = float(t_near @ p_near) / max(float(t_near @ t_near), np.finfo(float).tiny)
    to_exit = float(p_near.mean() - slope * t[near].mean() - position.mean())
    return _Exit(mass, to_exit + float(outside @ r) * T / mass if mass else 0.0, ends)


def _fit(t: np.ndarray) -> tuple[float, float, float]:
    r"""Return the log norm, alpha and beta of :math:`e^{-\alpha t - \beta t^2}` on 0 to 1.

    The likelihood of an exponential family is concave; its gradient is the difference of moments.
    """
    statistics = np.stack([_NODES, _NODES**2])
    wanted = np.array([t.mean(), (t**2).mean()])

    def negative(a: np.ndarray) -> tuple[float, np.ndarray]:
        log = -a @ statistics
        density = _WEIGHTS * np.exp(log - log.max())
        norm = density.sum()
        log_norm = float(np.log(norm) + log.max())
        return a @ wanted + log_norm, wanted - statistics @ density / norm

    best = minimise(negative, np.zeros(2), low=-_STEEPEST, high=_STEEPEST).x
    return negative(best)[0] - float(best @ wanted), float(best[0]), float(best[1])
