r"""Priors over a scene's parameters: of each parameter, and of several that correlate.

A prior maps a parameter's name to a distribution; a parameter without one has the scene's box. A
:class:`JointPrior` adds a correlation of the parameters' normal scores (a Gaussian copula, Nelsen
2006, Section 2.8): with the cumulative distribution function :math:`F_i` of each parameter,

.. math:: q_i = \Phi^{-1}(F_i(x_i)), \qquad q \sim N(0, R)

so that correlated log-normals are exactly that, and parameters that are cut to a range stay in it:
the density is normalised, and a draw is :math:`x_i = F_i^{-1}(\Phi(q_i))`, never rejected. The
parameters are sampled one after the other, each given those before,

.. math:: p(x_k \mid x_{<k}) = p_k(x_k)\, \frac{N(q_k;\, m_k, s_k^2)}{N(q_k;\, 0, 1)}, \qquad
          m_k = R_{k,<k} R_{<k,<k}^{-1} q_{<k}, \quad s_k^2 = 1 - R_{k,<k} R_{<k,<k}^{-1} R_{<k,k}
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from numpyro.distributions import constraints

from calibrate.state_names import split
from emulator.core.errors import InputError
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.parameter_space import Parameter

Prior = Mapping[str, dist.Distribution]

_SYMMETRIC = (dist.Normal, dist.StudentT, dist.Laplace, dist.Logistic, dist.Cauchy)
_BISECTIONS = 80  # halves an interval until double precision ends
_EDGE = 1e-15  # mass beyond which scores end, at 7.9 sd: the ends of a range have infinite ones


def box_prior(scene: ForwardProblem) -> dict[str, dist.Distribution]:
    """Return the priors that a scene's parameters have over their ranges.

    Uniform ones, log-uniform where the scale is ``log``, and the log-normals that the scene states.
    """
    return {p.name: _over_range(p) for p in scene.parameters}


def _over_range(parameter: Parameter) -> dist.Distribution:
    low, high = parameter.low, parameter.high
    if (prior := parameter.prior) is not None:
        return log_normal(prior.median, prior.log_sd, low, high)
    return dist.LogUniform(low, high) if parameter.scale == "log" else dist.Uniform(low, high)


def truncated_normal(
    mean: float, sd: float, low: float = -math.inf, high: float = math.inf
) -> dist.Distribution:
    """Return the normal with mean ``mean`` and sd ``sd``, cut to ``low`` ... ``high``.

    Raises
    ------
    InputError
        ``sd`` is not above 0, or ``low`` not below ``high``.
    """
    _check(low, high, sd=sd)
    first, last = (end if math.isfinite(end) else None for end in (low, high))
    return dist.TruncatedNormal(mean, sd, low=first, high=last)


def log_normal(
    median: float, log_sd: float, low: float = 0.0, high: float = math.inf
) -> dist.Distribution:
    """Return the log-normal with ``median`` and sd ``log_sd`` of the logarithm, cut to a range.

    ``log_sd`` is about the relative sd: 0.1 stands for 10 %.

    Raises
    ------
    InputError
        ``median`` or ``log_sd`` is not above 0, or ``low`` not below ``high``.
    """
    _check(low, high, median=median, log_sd=log_sd)
    whole = dist.LogNormal(math.log(median), log_sd)
    if low <= 0.0 and high == math.inf:
        return whole
    # Nine sd above the median the remaining mass is 0 in double precision.
    return _cut(whole, low, min(high, median * math.exp(9.0 * log_sd)))


def truncated(prior: Prior, scene: ForwardProblem) -> Prior:
    """Return ``prior`` with each distribution cut to the parameter's range in ``scene``.

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


def bounds(distribution: dist.Distribution) -> tuple[float, float]:
    """Return the ends of a distribution's support, infinite where it has none."""
    low = getattr(distribution.support, "lower_bound", -math.inf)
    high = getattr(distribution.support, "upper_bound", math.inf)
    return float(low), float(high)


def _cut(distribution: dist.Distribution, low: float, high: float) -> dist.Distribution:
    """Return ``distribution`` on the part of its support between ``low`` and ``high``."""
    first, last = bounds(distribution)
    if low <= first and last <= high:
        return distribution
    if not max(low, first) < min(high, last):
        raise InputError(f"prior {type(distribution).__name__} lies outside {low:g} to {high:g}")
    return Truncated(distribution, max(low, first), min(high, last))


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
    def _ends(self) -> tuple[jax.Array, jax.Array]:
        """Cumulative distribution function of the base at both ends."""
        return self._base_cdf(self.low), self._base_cdf(self.high)

    def _base_cdf(self, value: ArrayLike) -> jax.Array:
        """Return the base's cumulative distribution function, up to a constant.

        In an upper tail differences of numbers close to 1 would be round-off, so there it is
        F(x) - 1, by symmetry -F(2 m - x) about the middle m.
        """
        base, x, low = self.base_dist, jnp.asarray(value), self.low
        if isinstance(base, dist.LogNormal):
            base, x, low = dist.Normal(base.loc, base.scale), jnp.log(x), jnp.log(low)
        if not isinstance(base, _SYMMETRIC):
            return base.cdf(x)
        return jnp.where(low > base.loc, -base.cdf(2.0 * base.loc - x), base.cdf(x))

    def log_prob(self, value: ArrayLike) -> jax.Array:
        """Return the log density: the base's less the log of its mass inside; -inf outside."""
        below, above = self._ends
        inside = (value >= self.low) & (value <= self.high)
        safe = jnp.where(inside, value, 0.5 * (self.low + self.high))
        return jnp.where(inside, self.base_dist.log_prob(safe) - jnp.log(above - below), -jnp.inf)

    def cdf(self, value: ArrayLike) -> jax.Array:
        """Return the cumulative distribution function."""
        below, above = self._ends
        within = jnp.clip(value, self.low, self.high)
        return (self._base_cdf(within) - below) / (above - below)

    def icdf(self, q: ArrayLike) -> jax.Array:
        """Return quantiles, by bisection: many bases have no inverse of their own."""
        return bisect(self.cdf, q, self.low, self.high)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Return draws, by inversion."""
        return self.icdf(jax.random.uniform(key, sample_shape))


def bisect(
    cdf: Callable[[jax.Array], jax.Array], q: ArrayLike, low: ArrayLike, high: ArrayLike
) -> jax.Array:
    """Return the point between ``low`` and ``high`` where the increasing ``cdf`` reaches ``q``."""
    q = jnp.asarray(q)

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        middle = 0.5 * (ends[0] + ends[1])
        below = cdf(middle) < q
        return jnp.where(below, middle, ends[0]), jnp.where(below, ends[1], middle)

    begin = (jnp.full(q.shape, low, float), jnp.full(q.shape, high, float))
    first, last = jax.lax.fori_loop(0, _BISECTIONS, halve, begin)
    return 0.5 * (first + last)


@dataclass(frozen=True, eq=False)
class Dependence:
    """Correlation of the normal scores of some parameters.

    names : the parameters, (k,). correlation : (k, k), unit diagonal, positive definite.

    Raises
    ------
    InputError
        A matrix that is no correlation of these names.
    """

    names: tuple[str, ...]
    correlation: np.ndarray

    def __post_init__(self) -> None:
        R = np.array(self.correlation, dtype=float)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "correlation", R)
        count = len(self.names)
        if len(set(self.names)) != count or R.shape != (count, count):
            raise InputError(
                f"correlation has shape {R.shape}; give one row for each of "
                f"{', '.join(self.names)}, named once"
            )
        if not (np.allclose(R, R.T) and np.allclose(np.diag(R), 1.0)):
            raise InputError("correlation is not symmetric with ones on its diagonal")
        if not np.linalg.eigvalsh(R).min() > 1e-10:
            raise InputError(
                f"correlation of {', '.join(self.names)} is not positive definite: no parameters "
                "can have all these correlations"
            )

    def ordered(self, names: tuple[str, ...]) -> Dependence:
        """Return the dependence with its parameters in the order they have in ``names``.

        :class:`InputError` for one that is not among ``names``.
        """
        for name in self.names:
            if name not in names:
                raise InputError(
                    f"prior correlates '{name}', which is not inferred; inferred: "
                    f"{', '.join(names)}"
                )
        rows = sorted(range(len(self.names)), key=lambda k: names.index(self.names[k]))
        chosen = tuple(self.names[k] for k in rows)
        return Dependence(chosen, self.correlation[np.ix_(rows, rows)])

    def given_earlier(
        self, name: str, prior: Mapping[str, dist.Distribution], draw: Mapping[str, Any]
    ) -> tuple[ArrayLike, float]:
        """Return mean and sd of the score of ``name``, given the parameters before it."""
        k = self.names.index(name)
        before = self.correlation[:k, :k]
        weights = np.linalg.solve(before, self.correlation[:k, k]) if k else np.zeros(0)
        sd = float(np.sqrt(1.0 - weights @ self.correlation[:k, k]))
        scores = [_score(prior[n], draw[n]) for n in self.names[:k]]
        return sum((w * q for w, q in zip(weights, scores, strict=True)), jnp.zeros(())), sd

    def to_json(self) -> dict[str, Any]:
        """Return names and correlation."""
        return {"names": list(self.names), "correlation": self.correlation.tolist()}


class JointPrior(dict[str, dist.Distribution]):
    """A prior by parameter, as every prior, and how the parameters depend on each other.

    ``{**joint, "pressure": ...}`` is an ordinary prior without the dependence; to add a parameter,
    make a new joint prior.

    marginals : distribution of each parameter. Those that depend on each other need ``cdf`` and
        ``icdf``.
    dependence : the correlation of some of them.

    Raises
    ------
    InputError
        A parameter that depends on others and has no distribution.
    """

    def __init__(self, marginals: Prior, dependence: Dependence) -> None:
        super().__init__(marginals)
        dependence.ordered(tuple(marginals))
        self.dependence = dependence


def dependence_of(prior: Mapping[str, dist.Distribution] | None) -> Dependence | None:
    """Return the dependence between the parameters of ``prior``; ``None`` where independent."""
    return prior.dependence if isinstance(prior, JointPrior) else None


class Conditional(dist.Distribution):
    """One parameter given those before it: its marginal, its score normal(``centre``, ``width``).

    support : the support of the marginal, in the samplers' coordinates.
    """

    arg_constraints: dict = {}  # noqa: RUF012
    pytree_data_fields = ("marginal", "centre", "width", "_support")

    def __init__(
        self,
        marginal: dist.Distribution,
        centre: ArrayLike,
        width: float,
        support: constraints.Constraint,
    ) -> None:
        self.marginal, self._support = marginal, support
        self.centre, self.width = centre, width
        super().__init__(batch_shape=(), event_shape=())

    def log_prob(self, value: ArrayLike) -> jax.Array:
        """Return the log density; the marginal's ``-inf`` outside the support."""
        q = _score(self.marginal, value)
        change = 0.5 * (q**2 - ((q - self.centre) / self.width) ** 2) - jnp.log(self.width)
        return self.marginal.log_prob(value) + change

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Return draws, by inversion."""
        q = jnp.asarray(self.centre) + self.width * jax.random.normal(key, sample_shape)
        return self.marginal.icdf(jnp.clip(ndtr(q), _EDGE, 1.0 - _EDGE))


def _score(marginal: dist.Distribution, value: ArrayLike) -> jax.Array:
    """Return the normal score of ``value`` under ``marginal``."""
    return ndtri(jnp.clip(marginal.cdf(value), _EDGE, 1.0 - _EDGE))


def _check(low: float, high: float, **positive: float) -> None:
    for name, value in positive.items():
        if not 0.0 < value < math.inf:
            raise InputError(f"prior: {name} is {value}; it must be above 0 and finite")
    if not low < high:
        raise InputError(f"prior: no value lies between {low:g} and {high:g}")
