r"""Priors of several parameters together: any distribution of each, and a correlation.

Each parameter keeps the distribution it is given, with cumulative distribution function
:math:`F_i`. Their normal scores are correlated (a Gaussian copula, Nelsen 2006, Section 2.8),

.. math:: q_i = \Phi^{-1}(F_i(x_i)), \qquad q \sim N(0, R)

so that correlated log-normals are exactly that, and parameters that are cut to a range stay in it:
the density is normalised, and a draw is :math:`x_i = F_i^{-1}(\Phi(q_i))`, never rejected. The
parameters are sampled one after the other, each given those before,

.. math:: p(x_k \mid x_{<k}) = p_k(x_k)\, \frac{N(q_k;\, m_k, s_k^2)}{N(q_k;\, 0, 1)}, \qquad
          m_k = R_{k,<k} R_{<k,<k}^{-1} q_{<k}, \quad s_k^2 = 1 - R_{k,<k} R_{<k,<k}^{-1} R_{<k,k}
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from numpyro.distributions import constraints

from emulator.core.errors import InputError

_EDGE = 1e-15  # mass beyond which scores end, at 7.9 sd: the ends of a range have infinite ones


@dataclass(frozen=True, eq=False)
class Dependence:
    """Correlation of the normal scores of some parameters.

    names : of the parameters, (k,). correlation : (k, k), unit diagonal, positive definite.

    Raises
    ------
    InputError
        A matrix that is no correlation of these names.
    """

    names: tuple[str, ...]
    correlation: np.ndarray

    def __post_init__(self) -> None:
        given = np.array(self.correlation, dtype=float)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "correlation", given)
        count = len(self.names)
        if len(set(self.names)) != count or given.shape != (count, count):
            raise InputError(
                f"correlation has shape {given.shape}; give one row for each of "
                f"{', '.join(self.names)}, named once"
            )
        if not (np.allclose(given, given.T) and np.allclose(np.diag(given), 1.0)):
            raise InputError("correlation is not symmetric with ones on its diagonal")
        if not np.linalg.eigvalsh(given).min() > 1e-10:
            raise InputError(
                f"correlation of {', '.join(self.names)} is not positive definite: no parameters "
                "can have all these correlations"
            )

    def ordered(self, names: tuple[str, ...]) -> Dependence:
        """The dependence with its parameters in the order they have in ``names``.

        Raises
        ------
        InputError
            One that is not among ``names``.
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
        """Mean and sd of the score of ``name``, given the parameters before it in ``draw``."""
        k = self.names.index(name)
        before = self.correlation[:k, :k]
        weights = np.linalg.solve(before, self.correlation[:k, k]) if k else np.zeros(0)
        sd = float(np.sqrt(1.0 - weights @ self.correlation[:k, k]))
        scores = [score(prior[n], draw[n]) for n in self.names[:k]]
        return sum((w * q for w, q in zip(weights, scores, strict=True)), jnp.zeros(())), sd

    def to_json(self) -> dict[str, Any]:
        """Names and correlation."""
        return {"names": list(self.names), "correlation": self.correlation.tolist()}


@dataclass(frozen=True, eq=False)
class JointPrior(Mapping[str, dist.Distribution]):
    """A prior by parameter, as every prior, and how the parameters depend on each other.

    Parameters it does not name have the scene's box. ``{**joint, "pressure": ...}`` is an ordinary
    prior without the dependence; to add a parameter, make a new joint prior.

    Parameters
    ----------
    marginals : distribution of each parameter. Those that depend on each other need ``cdf`` and
        ``icdf``.
    dependence : of some of them.

    Raises
    ------
    InputError
        A parameter that depends on others and has no distribution.
    """

    marginals: Mapping[str, dist.Distribution]
    dependence: Dependence

    def __post_init__(self) -> None:
        self.dependence.ordered(tuple(self.marginals))

    def __getitem__(self, name: str) -> dist.Distribution:
        return self.marginals[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.marginals)

    def __len__(self) -> int:
        return len(self.marginals)


def dependence_of(prior: Mapping[str, dist.Distribution] | None) -> Dependence | None:
    """How the parameters of ``prior`` depend on each other; ``None`` of independent ones."""
    return prior.dependence if isinstance(prior, JointPrior) else None


class Conditional(dist.Distribution):
    """One parameter given those before it: its marginal, its score normal(``centre``, ``width``).

    support : of the marginal, in the coordinates samplers use.
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

    @property
    def support(self) -> constraints.Constraint:
        """The marginal's support."""
        return self._support

    def log_prob(self, value: ArrayLike) -> jax.Array:
        """Log density; the marginal's ``-inf`` outside the support."""
        q = score(self.marginal, value)
        change = 0.5 * (q**2 - ((q - self.centre) / self.width) ** 2) - jnp.log(self.width)
        return self.marginal.log_prob(value) + change

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draws, by inversion."""
        q = jnp.asarray(self.centre) + self.width * jax.random.normal(key, sample_shape)
        return quantile(self.marginal, q)


def score(marginal: dist.Distribution, value: ArrayLike) -> jax.Array:
    """Normal score of ``value`` under ``marginal``."""
    return ndtri(jnp.clip(marginal.cdf(value), _EDGE, 1.0 - _EDGE))


def quantile(marginal: dist.Distribution, q: jax.Array) -> jax.Array:
    """The value whose normal score is ``q``."""
    return marginal.icdf(jnp.clip(ndtr(q), _EDGE, 1.0 - _EDGE))
