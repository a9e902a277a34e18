r"""Members of a population: one statistical model of all of them.

Each member i is a :class:`~calibrate.statistical_model.Model` with its own body, loads, noise and
data. Some unknowns of theta, the shared ones, differ from member to member as the population does.
On the scale of the scene's parameter (:math:`x = \ln\theta` where it is logarithmic, else
:math:`x = \theta`), with the parameter's range l ... h there and :math:`w = h - l`,

.. math::
    q_i = L z_i, \quad z_i \sim N(0, I), \qquad L L^T = R \sim \text{LKJ}(\eta), \qquad
    x_{ik} = F_k^{-1}(\Phi(q_{ik})), \\
    m_k \sim N\big(\tfrac12 (l_k + h_k), (\tfrac12 w_k)^2\big) \text{ on } (l_k, h_k), \qquad
    s_k \sim \text{HalfNormal}(\tfrac14 w_k)

where :math:`F_k` is the normal distribution function of mean :math:`m_k` and sd :math:`s_k`, cut to
the range (``cut_normal``): outside of it a forward map has no answer. So a member's density given
the population is that of correlated normals, cut,

.. math::
    p(x_i \mid m, s, R) = \frac{N(q_i; 0, R)}{\prod_k \phi(q_{ik})}
    \prod_k \frac{N(x_{ik}; m_k, s_k^2)}{\Phi(b_k) - \Phi(a_k)}, \qquad
    a_k = \frac{l_k - m_k}{s_k}, \; b_k = \frac{h_k - m_k}{s_k},

and where the population is far from both ends, :math:`x_i = m + \text{diag}(s) L z_i`. This is the
form of :class:`calibrate.Population` (log-normals cut to the range, normal scores correlated), so
that :math:`e^m` is the median, :math:`s` about the relative sd. All that a member has to itself
keeps the prior of its model.

The LKJ distribution is that of Lewandowski, Kurowicka and Joe (2009): the density of R is
proportional to :math:`\det(R)^{\eta - 1}`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from numpyro import handlers

from calibrate.population.cut_normal import from_score
from calibrate.population.shared import (
    check_own,
    check_same,
    ends,
    from_scale,
    shared_names,
    to_scale,
)
from calibrate.priors import log_normal, truncated, truncated_normal
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.prior_range import standardised
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import Parameter

MEDIAN, SD, CHOLESKY, SCORES = "median", "sd", "correlation_cholesky", "scores"


@dataclass(frozen=True, eq=False)
class HierarchicalModel:
    """A NumPyro model of all members: call it with data by member. :func:`hierarchical_model`.

    Parameters
    ----------
    members : model of each member, by name.
    shared : the unknowns that follow the population, with the scenes' parameter of each.
    median : prior of the population's median of each, in the parameter's unit.
    spread : prior of the population's sd of each, on the parameter's scale.
    eta : of the LKJ distribution of their correlation; 1 is uniform, more prefers none.
    """

    members: Mapping[str, Model]
    shared: Mapping[str, Parameter]
    median: Mapping[str, dist.Distribution]
    spread: Mapping[str, dist.Distribution]
    eta: float = 2.0

    def __call__(self, data: Mapping[str, Data] | None = None) -> None:
        """The NumPyro program; members that ``data`` does not name say nothing."""
        median = [numpyro.sample(f"{MEDIAN}[{k}]", self.median[k]) for k in self.shared]
        spread = [numpyro.sample(f"{SD}[{k}]", standardised(self.spread[k])) for k in self.shared]
        count = len(self.shared)
        factor = jnp.eye(count)
        if count > 1:
            factor = numpyro.sample(CHOLESKY, dist.LKJCholesky(count, concentration=self.eta))
        normal = dist.Normal(0.0, 1.0).expand((len(self.members), count)).to_event(2)
        z = numpyro.sample(SCORES, normal)
        values = self.shared_values(jnp.stack(median), jnp.stack(spread), factor, z)
        draws = {}
        for i, (member, model) in enumerate(self.members.items()):
            draws[member] = {name: values[name][i] for name in self.shared}
            for name in self.own[member]:
                prior = model.given_earlier(name, model.sampled_priors[name], draws[member])
                draws[member][name] = numpyro.sample(f"{name}[{member}]", prior)
        given = data or {}
        for model, names in self._groups(given):
            with handlers.block():
                stacked = [draws[n] for n in names], [given[n] for n in names]
                found = _log_likelihoods(model, *stacked)
            numpyro.factor(f"data of {', '.join(names)}", jnp.sum(found))

    @cached_property
    def own(self) -> dict[str, tuple[str, ...]]:
        """Unknowns that each member has to itself, by member."""
        return {
            member: tuple(name for name in model.sampled_priors if name not in self.shared)
            for member, model in self.members.items()
        }

    def shared_values(
        self, median: jax.Array, spread: jax.Array, factor: jax.Array, z: jax.Array
    ) -> dict[str, jax.Array]:
        """Shared unknowns by name, each (...), in their units.

        ``median`` and ``spread`` (k,), ``factor`` L (k, k), standard normal ``z`` (..., k).
        """
        q = jnp.einsum("kl,...l->...k", factor, z)
        found = {}
        for k, (name, parameter) in enumerate(self.shared.items()):
            low, high = ends(parameter)
            x = from_score(q[..., k], to_scale(parameter, median[k]), spread[k], low, high)
            found[name] = from_scale(parameter, x)
        return found

    def _groups(self, data: Mapping[str, Any]) -> list[tuple[Model, list[str]]]:
        """Members with data, those of one and the same model together: one program for them."""
        found: dict[int, tuple[Model, list[str]]] = {}
        for member, model in self.members.items():
            if member in data:
                found.setdefault(id(model), (model, []))[1].append(member)
        return list(found.values())


def _log_likelihoods(
    model: Model, draws: list[dict[str, jax.Array]], data: list[Data]
) -> jax.Array:
    """Log density of each member's data, (members,)."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *draws)
    values = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(dict, data))
    return jax.vmap(model.map_log_likelihood)(stacked, values)


def hierarchical_model(
    members: Mapping[str, Model],
    *,
    shared: Sequence[str] | None = None,
    median: Mapping[str, dist.Distribution] | None = None,
    spread: Mapping[str, dist.Distribution | float] | None = None,
    eta: float = 2.0,
) -> HierarchicalModel:
    """The model of members of one population.

    Parameters
    ----------
    shared : unknowns that follow the population; by default all that every member has and that are
        no parameters of its loads.
    median : prior of the population's median, by shared name, in the parameter's unit.
    spread : prior of the population's sd on the parameter's scale (of the logarithm where that is
        logarithmic), by shared name; a number is the scale of a half-normal.

    Raises
    ------
    InputError
        No member, a shared name that a member does not infer, members with different ranges, scales
        or units of a shared parameter, a joint prior between shared and own unknowns, a prior that
        does not fit.
    """
    if not members:
        raise InputError("hierarchy: no members; give a model and data by member's name")
    names = shared_names(members, shared)
    parameters = {name: check_same(members, name) for name in names}
    check_own(members, names)
    if not eta > 0.0:
        raise InputError(f"hierarchy: eta is {eta}; it must be above 0")
    for role, given in (("median", median), ("spread", spread)):
        for name in given or {}:
            if name not in names:
                raise InputError(f"hierarchy: {role} of '{name}'; shared: {', '.join(names)}")
    scene = next(iter(members.values())).forward.scene
    medians = {n: (median or {}).get(n, _median(p)) for n, p in parameters.items()}
    spreads = {n: _spread(n, p, (spread or {}).get(n)) for n, p in parameters.items()}
    return HierarchicalModel(
        dict(members), parameters, truncated(medians, scene), spreads, float(eta)
    )


def _median(parameter: Parameter) -> dist.Distribution:
    """Normal on the scale: the middle of the range, half its width."""
    low, high = ends(parameter)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    given = log_normal if parameter.scale == "log" else truncated_normal
    return given(from_scale(parameter, middle), half, parameter.low, parameter.high)


def _spread(
    name: str, parameter: Parameter, given: dist.Distribution | float | None
) -> dist.Distribution:
    if given is None:
        low, high = ends(parameter)
        given = 0.25 * (high - low)
    if isinstance(given, dist.Distribution):
        return given
    if not 0.0 < given < float("inf"):
        raise InputError(
            f"hierarchy: spread of '{name}' is {given}; give a number above 0, or a distribution"
        )
    return dist.HalfNormal(given)
