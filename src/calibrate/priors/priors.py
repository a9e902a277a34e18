"""Priors over a scene's parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax.typing import ArrayLike
from numpyro.distributions import constraints

from calibrate.priors.joint_prior import JointPrior, dependence_of
from calibrate.state_names import split
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene

Prior = Mapping[str, dist.Distribution]

_BISECTIONS = 80  # halves an interval until double precision ends


def box_prior(scene: Scene) -> dict[str, dist.Distribution]:
    """Uniform over each parameter's range, on its scale: log-uniform where that is ``log``."""
    return {
        p.name: dist.LogUniform(p.low, p.high) if p.scale == "log" else dist.Uniform(p.low, p.high)
        for p in scene.parameters
    }


def truncated_normal(
    mean: float, sd: float, low: float = -math.inf, high: float = math.inf
) -> dist.Distribution:
    """Normal with mean ``mean`` and sd ``sd`` before it is cut to ``low`` ... ``high``.

    Raises
    ------
    InputError
        ``sd`` is not above 0, or ``low`` not below ``high``.
    """
    _check_positive("sd", sd)
    _check_order(low, high)
    return dist.TruncatedNormal(
        mean,
        sd,
        low=low if math.isfinite(low) else None,
        high=high if math.isfinite(high) else None,
    )


def log_normal(
    median: float, log_sd: float, low: float = 0.0, high: float = math.inf
) -> dist.Distribution:
    """Log-normal with ``median`` and sd ``log_sd`` of the logarithm, cut to ``low`` ... ``high``.

    ``log_sd`` is about the relative sd: 0.1 stands for 10 %.

    Raises
    ------
    InputError
        ``median`` or ``log_sd`` is not above 0, or ``low`` not below ``high``.
    """
    _check_positive("median", median)
    _check_positive("log_sd", log_sd)
    _check_order(low, high)
    whole = dist.LogNormal(math.log(median), log_sd)
    if low <= 0.0 and high == math.inf:
        return whole
    # Nine sd above the median no mass is left in double precision.
    return _cut(whole, low, min(high, median * math.exp(9.0 * log_sd)))


def truncated(prior: Prior, scene: Scene) -> Prior:
    """``prior`` with each distribution cut to the parameter's range in ``scene``.

    A posterior under it speaks about the range only: a parameter that piles up at an end of it is
    probably outside. A joint prior keeps its correlations.
    """
    ranges = {p.name: (p.low, p.high) for p in scene.parameters}
    for name in prior:
        if split(name)[0] not in ranges:
            raise InputError(f"prior names '{name}'; scene '{scene.name}' has {', '.join(ranges)}")
    cut = {name: _cut(d, *ranges[split(name)[0]]) for name, d in prior.items()}
    dependence = dependence_of(prior)
    return cut if dependence is None else JointPrior(cut, dependence)


class Truncated(dist.Distribution):
    r"""Any scalar distribution cut to an interval.

    .. math:: p(x) = \frac{p_0(x)}{P_0(\text{high}) - P_0(\text{low})}, \quad
              \text{low} \le x \le \text{high}

    with density :math:`p_0` and cumulative distribution function :math:`P_0` of ``base_dist``.
    """

    arg_constraints = {"low": constraints.real, "high": constraints.real}  # noqa: RUF012
    pytree_data_fields = ("base_dist", "low", "high", "_support")

    def __init__(self, base_dist: dist.Distribution, low: float, high: float) -> None:
        self.base_dist, self.low, self.high = base_dist, jnp.asarray(low), jnp.asarray(high)
        self._support = constraints.interval(self.low, self.high)
        super().__init__(batch_shape=(), event_shape=())

    @property
    def support(self) -> constraints.Constraint:
        """The interval."""
        return self._support

    @property
    def _ends(self) -> tuple[jax.Array, jax.Array]:
        """Cumulative distribution function of the base at both ends."""
        return self.base_dist.cdf(self.low), self.base_dist.cdf(self.high)

    def log_prob(self, value: ArrayLike) -> jax.Array:
        """Log density of the base less the log of its mass in the interval; -inf outside."""
        below, above = self._ends
        inside = self._support(value)
        safe = jnp.where(inside, value, 0.5 * (self.low + self.high))
        return jnp.where(inside, self.base_dist.log_prob(safe) - jnp.log(above - below), -jnp.inf)

    def cdf(self, value: ArrayLike) -> jax.Array:
        """Cumulative distribution function."""
        below, above = self._ends
        within = jnp.clip(value, self.low, self.high)
        return (self.base_dist.cdf(within) - below) / (above - below)

    def icdf(self, q: ArrayLike) -> jax.Array:
        """Quantiles, by bisection: many bases have no inverse of their own."""
        return bisect(self.cdf, q, self.low, self.high)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draws, by inversion."""
        return self.icdf(jax.random.uniform(key, sample_shape))


def bisect(
    cdf: Callable[[jax.Array], jax.Array], q: ArrayLike, low: ArrayLike, high: ArrayLike
) -> jax.Array:
    """Where the increasing function ``cdf`` reaches ``q`` between ``low`` and ``high``."""
    q = jnp.asarray(q)

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        middle = 0.5 * (ends[0] + ends[1])
        below = cdf(middle) < q
        return jnp.where(below, middle, ends[0]), jnp.where(below, ends[1], middle)

    begin = (jnp.full(q.shape, low, float), jnp.full(q.shape, high, float))
    first, last = jax.lax.fori_loop(0, _BISECTIONS, halve, begin)
    return 0.5 * (first + last)


def bounds(distribution: dist.Distribution) -> tuple[float, float]:
    """Ends of a distribution's support, infinite where it has none."""
    low = getattr(distribution.support, "lower_bound", -math.inf)
    high = getattr(distribution.support, "upper_bound", math.inf)
    return float(low), float(high)


def _cut(distribution: dist.Distribution, low: float, high: float) -> dist.Distribution:
    """``distribution`` on the part of its support between ``low`` and ``high``."""
    first, last = bounds(distribution)
    if low <= first and last <= high:
        return distribution
    if not max(low, first) < min(high, last):
        raise InputError(f"prior {type(distribution).__name__} lies outside {low:g} to {high:g}")
    low, high = max(low, first), min(high, last)
    return Truncated(distribution, low, high)


def _check_positive(name: str, value: float) -> None:
    if not 0.0 < value < math.inf:
        raise InputError(f"prior: {name} is {value}; it must be above 0 and finite")


def _check_order(low: float, high: float) -> None:
    if not low < high:
        raise InputError(f"prior: no value lies between {low:g} and {high:g}")
