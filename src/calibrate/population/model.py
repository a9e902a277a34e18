r"""The statistical model of a population and its members.

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
the range (:mod:`calibrate.population.coordinates`): outside of it a forward map has no answer. So a
member's density given the population is that of correlated normals, cut,

.. math::
    p(x_i \mid m, s, R) = \frac{N(q_i; 0, R)}{\prod_k \phi(q_{ik})}
    \prod_k \frac{N(x_{ik}; m_k, s_k^2)}{\Phi(b_k) - \Phi(a_k)}, \qquad
    a_k = \frac{l_k - m_k}{s_k}, \; b_k = \frac{h_k - m_k}{s_k},

and where the population is far from both ends, :math:`x_i = m + \text{diag}(s) L z_i`. This is the
form of :class:`calibrate.Population` (log-normals cut to the range, normal scores correlated), so
that :math:`e^m` is the median, :math:`s` about the relative sd. The own unknowns of a member, which
are all others, keep the prior of its model.

The LKJ distribution is that of Lewandowski, Kurowicka and Joe (2009): the density of R is
proportional to :math:`\det(R)^{\eta - 1}`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from numpyro import handlers

from calibrate.population.coordinates import from_score
from calibrate.priors import log_normal, truncated, truncated_normal
from calibrate.state_names import split
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.prior_range import standardised
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import Parameter

MEDIAN, SD, CHOLESKY, SCORES = "median", "sd", "correlation_cholesky", "scores"


def to_scale(parameter: Parameter, value: Any) -> Any:
    """Return ``value`` on the parameter's scale: its logarithm, or itself."""
    return jnp.log(value) if parameter.scale == "log" else value


def from_scale(parameter: Parameter, x: Any) -> Any:
    """Return the value at ``x`` on the parameter's scale, the inverse of :func:`to_scale`."""
    return jnp.exp(x) if parameter.scale == "log" else x


def ends(parameter: Parameter) -> tuple[float, float]:
    """Return both ends of the parameter's range, on its scale."""
    if parameter.scale == "log":
        return math.log(parameter.low), math.log(parameter.high)
    return parameter.low, parameter.high


@dataclass(frozen=True, eq=False)
class PopulationModel:
    """A NumPyro model of all members, called with data by member; see :func:`population_model`.

    Parameters
    ----------
    members : the model of each member, by name.
    shared : the unknowns that follow the population, with the scenes' parameter of each.
    median : the prior of the population's median of each, in the parameter's unit.
    spread : the prior of the population's sd of each, on the parameter's scale.
    eta : the parameter of the LKJ distribution of their correlation; 1 is uniform, more prefers
        none.
    """

    members: Mapping[str, Model]
    shared: Mapping[str, Parameter]
    median: Mapping[str, dist.Distribution]
    spread: Mapping[str, dist.Distribution]
    eta: float = 2.0

    def __call__(self, data: Mapping[str, Data] | None = None) -> None:
        """Run the NumPyro program; a member that ``data`` does not name has no likelihood."""
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
        data = data or {}
        for model, names in self._groups(data):
            with handlers.block():
                stacked = [draws[n] for n in names], [data[n] for n in names]
                log_likelihoods = _log_likelihoods(model, *stacked)
            numpyro.factor(f"data of {', '.join(names)}", jnp.sum(log_likelihoods))

    @cached_property
    def own(self) -> dict[str, tuple[str, ...]]:
        """Unknowns that do not follow the population, by member."""
        return {
            member: tuple(name for name in model.sampled_priors if name not in self.shared)
            for member, model in self.members.items()
        }

    def shared_values(
        self, median: jax.Array, spread: jax.Array, factor: jax.Array, z: jax.Array
    ) -> dict[str, jax.Array]:
        """Return shared unknowns by name, each (...), in their units.

        Parameters
        ----------
        median, spread : the population's medians and sds (k,).
        factor : the lower factor L (k, k) of its correlation. z : standard normal scores (..., k).
        """
        q = jnp.einsum("kl,...l->...k", factor, z)
        values = {}
        for k, (name, parameter) in enumerate(self.shared.items()):
            low, high = ends(parameter)
            x = from_score(q[..., k], to_scale(parameter, median[k]), spread[k], low, high)
            values[name] = from_scale(parameter, x)
        return values

    def _groups(self, data: Mapping[str, Any]) -> list[tuple[Model, list[str]]]:
        """Return members with data, grouped by their model: one program for each group."""
        groups: dict[int, tuple[Model, list[str]]] = {}
        for member, model in self.members.items():
            if member in data:
                groups.setdefault(id(model), (model, []))[1].append(member)
        return list(groups.values())


def _log_likelihoods(
    model: Model, draws: list[dict[str, jax.Array]], data: list[Data]
) -> jax.Array:
    """Return the log density of each member's data, (members,)."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *draws)
    values = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(dict, data))
    return jax.vmap(model.map_log_likelihood)(stacked, values)


def population_model(
    members: Mapping[str, Model],
    *,
    shared: Sequence[str] | None = None,
    median: Mapping[str, dist.Distribution] | None = None,
    spread: Mapping[str, dist.Distribution | float] | None = None,
    eta: float = 2.0,
) -> PopulationModel:
    """Return the model of a population and its members.

    Parameters
    ----------
    shared : the unknowns that follow the population; by default all that every member has and that
        are no parameters of its loads.
    median : the prior of the population's median, by shared name, in the parameter's unit.
    spread : the prior of the population's sd on the parameter's scale (of the logarithm where that
        is logarithmic), by shared name; a number is the scale of a half-normal.

    Raises
    ------
    InputError
        No member, a shared name that a member does not infer, members with different ranges, scales
        or units of a shared parameter, a joint prior between shared and own unknowns, a prior that
        does not fit.
    """
    if not members:
        raise InputError("hierarchy: no members; give a model and data by member's name")
    names = _shared_names(members, shared)
    parameters = {name: _common_parameter(members, name) for name in names}
    _check_own(members, names)
    if not eta > 0.0:
        raise InputError(f"hierarchy: eta is {eta}; it must be above 0")
    for role, priors in (("median", median), ("spread", spread)):
        for name in priors or {}:
            if name not in names:
                raise InputError(f"hierarchy: {role} of '{name}'; shared: {', '.join(names)}")
    scene = next(iter(members.values())).forward.scene
    medians = {n: (median or {}).get(n, _median_prior(p)) for n, p in parameters.items()}
    spreads = {n: _spread_prior(n, p, (spread or {}).get(n)) for n, p in parameters.items()}
    return PopulationModel(
        dict(members), parameters, truncated(medians, scene), spreads, float(eta)
    )


def _median_prior(parameter: Parameter) -> dist.Distribution:
    """Return a normal on the scale: mean in the middle of the range, sd half its width."""
    low, high = ends(parameter)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    kind = log_normal if parameter.scale == "log" else truncated_normal
    return kind(from_scale(parameter, middle), half, parameter.low, parameter.high)


def _spread_prior(
    name: str, parameter: Parameter, spread: dist.Distribution | float | None
) -> dist.Distribution:
    if spread is None:
        low, high = ends(parameter)
        spread = 0.25 * (high - low)
    if isinstance(spread, dist.Distribution):
        return spread
    if not 0.0 < spread < float("inf"):
        raise InputError(
            f"hierarchy: spread of '{name}' is {spread}; give a number above 0, or a distribution"
        )
    return dist.HalfNormal(spread)


def _shared_names(members: Mapping[str, Model], names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the unknowns that follow the population, checked, in the first member's order."""
    unknowns = {member: model.states.unknowns for member, model in members.items()}
    if names is None:
        first, *others = unknowns
        loads = {p for model in members.values() for p in model.forward.scene.load_parameters}
        common = tuple(
            name
            for name in unknowns[first]
            if split(name)[0] not in loads and all(name in unknowns[m] for m in others)
        )
        if not common:
            raise InputError("hierarchy: no unknown but those of loads is one of every member")
        return common
    if not names or len(set(names)) != len(names) or isinstance(names, str):
        raise InputError(f"hierarchy: shared is {names!r}; give one or more names, each once")
    for name in names:
        for member, own in unknowns.items():
            if name not in own:
                raise InputError(
                    f"hierarchy: member '{member}' does not infer '{name}'; it infers "
                    f"{', '.join(own)}"
                )
    return tuple(names)


def _common_parameter(members: Mapping[str, Model], name: str) -> Parameter:
    """Return the parameter of the unknown ``name``, which has to be the same for every member."""
    parameters: dict[str, Parameter] = {}
    for member, model in members.items():
        scene = model.forward.scene
        parameters[member] = scene.parameters[scene.parameter_names.index(split(name)[0])]
    (first, parameter), *others = parameters.items()
    for member, other in others:
        if other != parameter:
            raise InputError(
                f"hierarchy: '{name}' is {_in_words(parameter)} for '{first}' and "
                f"{_in_words(other)} for '{member}': a population has one range and one scale"
            )
    return parameter


def _check_own(members: Mapping[str, Model], shared: Sequence[str]) -> None:
    """Raise an :class:`InputError` where a prior ties own unknowns of a member to shared ones."""
    for member, model in members.items():
        tied = () if model.dependence is None else model.dependence.names
        if len({name in shared for name in tied}) > 1:
            raise InputError(
                f"hierarchy: the prior of member '{member}' correlates {', '.join(tied)}, of which "
                "only some follow the population"
            )


def _in_words(parameter: Parameter) -> str:
    words = f"{parameter.low:g} to {parameter.high:g} {parameter.unit} ({parameter.scale})"
    return words.replace("  ", " ")
