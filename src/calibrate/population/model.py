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
the range: outside of it a forward map has no answer. So a member's density given the population is
that of correlated normals, cut,

.. math::
    p(x_i \mid m, s, R) = \frac{N(q_i; 0, R)}{\prod_k \phi(q_{ik})}
    \prod_k \frac{N(x_{ik}; m_k, s_k^2)}{\Phi(b_k) - \Phi(a_k)}, \qquad
    a_k = \frac{l_k - m_k}{s_k}, \; b_k = \frac{h_k - m_k}{s_k},

and where the population is far from both ends, :math:`x_i = m + \text{diag}(s) L z_i`. This is the
form of :class:`calibrate.priors.Population` (log-normals cut to the range, normal scores
correlated), so that :math:`e^m` is the median, :math:`s` about the relative sd. The own unknowns of
a member, which are all others, keep the prior of its model.

A value x of a normal of mean m and sd s, cut to (l, h), has the normal score q,

.. math:: x = m + s\,\Phi^{-1}\big(\Phi(a) + \Phi(q)\,[\Phi(b) - \Phi(a)]\big), \qquad
          a = \frac{l - m}{s}, \quad b = \frac{h - m}{s}

so that its distribution function at x is :math:`\Phi(q)`. Where both ends are many sd away,
:math:`x = m + s q`. The map is smooth in m, s and q, and never leaves the interval. Its slope is

.. math:: \frac{dx}{dq} = s\, \frac{\phi(q)}{\phi(t)}\, [\Phi(b) - \Phi(a)], \qquad t = (x - m) / s

The LKJ distribution is that of Lewandowski, Kurowicka and Joe (2009): the density of R is
proportional to :math:`\det(R)^{\eta - 1}`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from numpyro import handlers

from calibrate.priors import log_normal, truncated, truncated_normal
from calibrate.state_names import split
from calibrate.statistical_model import Data, Model
from calibrate.statistical_model.prior_range import standardised
from emulator.core.errors import InputError
from emulator.scenes.parameter_space import Parameter

MEDIAN, SD, CHOLESKY, SCORES = "median", "sd", "correlation_cholesky", "scores"
_LEAST = 1e-300  # least mass at which ndtri is finite
_FARTHEST = 30.0  # sd to which values farther from the mean are clipped


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


def from_score(
    score: jax.Array, mean: ArrayLike, sd: ArrayLike, low: ArrayLike, high: ArrayLike
) -> jax.Array:
    """Return the value in (``low``, ``high``) of a normal ``score``; all arguments broadcast.

    ``mean`` lies between ``low`` and ``high``.
    """
    a, b = (low - jnp.asarray(mean)) / sd, (high - jnp.asarray(mean)) / sd
    # Scores above 0 are counted from the upper end: 1 - 1e-17 is 1, 1e-17 is not 0.
    upper = score > 0.0
    q = jnp.where(upper, -score, score)
    lower_end, upper_end = jnp.where(upper, -b, a), jnp.where(upper, -a, b)
    mass = ndtr(lower_end) + ndtr(q) * (ndtr(upper_end) - ndtr(lower_end))
    t = ndtri(jnp.maximum(mass, _LEAST))
    # Round-off may leave the interval by its last digit.
    return jnp.clip(mean + sd * jnp.where(upper, -t, t), low, high)


def to_score(
    value: jax.Array, mean: ArrayLike, sd: ArrayLike, low: ArrayLike, high: ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """Return the normal score q of ``value``, the inverse of :func:`from_score`, and dx/dq."""
    a, b = (low - jnp.asarray(mean)) / sd, (high - jnp.asarray(mean)) / sd
    t = jnp.clip((value - jnp.asarray(mean)) / sd, -_FARTHEST, _FARTHEST)
    upper = t > 0.0
    lower_end, upper_end = jnp.where(upper, -b, a), jnp.where(upper, -a, b)
    total_mass = ndtr(upper_end) - ndtr(lower_end)
    mass = (ndtr(jnp.where(upper, -t, t)) - ndtr(lower_end)) / total_mass
    q = ndtri(jnp.maximum(mass, _LEAST))
    slope = jnp.asarray(sd) * total_mass * jnp.exp(0.5 * (t**2 - q**2))
    return jnp.where(upper, -q, q), slope


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
        median = [
            numpyro.sample(f"{MEDIAN}[{k}]", standardised(self.median[k])) for k in self.shared
        ]
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
            for name in self.unshared[member]:
                prior = model.given_earlier(name, model.sampled_priors[name], draws[member])
                draws[member][name] = numpyro.sample(f"{name}[{member}]", prior)
        data = data or {}
        groups: dict[int, tuple[Model, list[str]]] = {}  # one program for each model
        for member, model in self.members.items():
            if member in data:
                groups.setdefault(id(model), (model, []))[1].append(member)
        for model, names in groups.values():
            stacked = [_stacked([by[n] for n in names]) for by in (draws, data)]
            with handlers.block():
                log_likelihoods = jax.vmap(model.map_log_likelihood)(*stacked)
            numpyro.factor(f"data of {', '.join(names)}", jnp.sum(log_likelihoods))

    @cached_property
    def unshared(self) -> dict[str, tuple[str, ...]]:
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


def _stacked(members: Sequence[Mapping[str, Any]]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(dict, members))


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
    for member, model in members.items():
        tied = () if model.dependence is None else model.dependence.names
        if len({name in names for name in tied}) > 1:
            raise InputError(
                f"hierarchy: the prior of member '{member}' correlates {', '.join(tied)}, of which "
                "only some follow the population"
            )
    if not eta > 0.0:
        raise InputError(f"hierarchy: eta is {eta}; it must be above 0")
    for role, priors in (("median", median), ("spread", spread)):
        for name in priors or {}:
            if name not in names:
                raise InputError(f"hierarchy: {role} of '{name}'; shared: {', '.join(names)}")
    medians: dict[str, dist.Distribution] = {}
    spreads: dict[str, dist.Distribution] = {}
    for name, parameter in parameters.items():
        low, high = ends(parameter)
        middle, half = from_scale(parameter, 0.5 * (low + high)), 0.5 * (high - low)
        kind = log_normal if parameter.scale == "log" else truncated_normal
        usual = kind(middle, half, parameter.low, parameter.high)
        medians[name] = (median or {}).get(name, usual)
        prior = (spread or {}).get(name, 0.5 * half)
        if not (isinstance(prior, dist.Distribution) or 0.0 < prior < math.inf):
            raise InputError(
                f"hierarchy: spread of '{name}' is {prior}; give a number above 0, or a "
                "distribution"
            )
        spreads[name] = prior if isinstance(prior, dist.Distribution) else dist.HalfNormal(prior)
    cut = truncated(medians, next(iter(members.values())).forward.scene)
    return PopulationModel(dict(members), parameters, cut, spreads, float(eta))


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
        for member, inferred in unknowns.items():
            if name not in inferred:
                raise InputError(
                    f"hierarchy: member '{member}' does not infer '{name}'; it infers "
                    f"{', '.join(inferred)}"
                )
    return tuple(names)


def _common_parameter(members: Mapping[str, Model], name: str) -> Parameter:
    """Return the parameter of the unknown ``name``; InputError where members differ in it."""
    scenes = {member: model.forward.scene for member, model in members.items()}
    base = split(name)[0]
    parameters = {m: s.parameters[s.parameter_names.index(base)] for m, s in scenes.items()}
    (first, parameter), *others = parameters.items()
    for member, other in others:
        # A member has the prior of its run; the scene file may state another for each.
        if replace(other, prior=None) != replace(parameter, prior=None):
            raise InputError(
                f"hierarchy: '{name}' is {_in_words(parameter)} for '{first}' and "
                f"{_in_words(other)} for '{member}': a population has one range and one scale"
            )
    return parameter


def _in_words(parameter: Parameter) -> str:
    words = f"{parameter.low:g} to {parameter.high:g} {parameter.unit} ({parameter.scale})"
    return words.replace("  ", " ")
