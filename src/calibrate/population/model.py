r"""The statistical model of a population and its members.

Each member i is a :class:`~calibrate.statistical_model.Model` with its own body, loads, noise and
data. Some unknowns of theta, the shared ones, differ from member to member as the population does.
On the scale of the scene's parameter (:math:`x = \ln\theta` where it is logarithmic, else
:math:`x = \theta`), with the parameter's range l ... h there, and the prior :math:`\pi_k` that the
first member's model has of it,

.. math::
    q_i = L z_i, \quad z_i \sim N(0, I), \qquad L L^T = R \sim \text{LKJ}(\eta), \qquad
    x_{ik} = F_k^{-1}(\Phi(q_{ik})), \\
    m_k \sim \pi_k, \qquad s_k \sim \text{HalfNormal}\big(\tfrac12 \text{sd}(\pi_k)\big)

so that the median is somewhere in the members' prior, and members rarely scatter as widely as that.
Here :math:`F_k` is the normal distribution function of mean :math:`m_k` and sd :math:`s_k`, cut to
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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike

from calibrate.priors import truncated
from calibrate.state_names import split
from calibrate.statistical_model import Model
from calibrate.statistical_model.prior_range import standardised
from emulator.core.errors import InputError
from emulator.core.small_matrices import eliminate
from emulator.scenes.parameter_space import Parameter

MEDIAN, SD, CHOLESKY = "median", "sd", "correlation_cholesky"
_LEAST = 1e-300  # least mass at which ndtri is finite
_FARTHEST = 30.0  # sd to which values farther from the mean are clipped
_FAR = 8.3  # sd from the mean to both ends, from which a cut changes nothing in double precision
_DRAWS = 4000  # of a prior, from which its sd is estimated
_SCATTER = 0.5  # scale of the prior of the population's sd, over the sd of the members' prior


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


class PopulationDraws(NamedTuple):
    """Median and sd (k,) of a population, and the lower factor L (k, k) of its correlation."""

    median: jax.Array
    sd: jax.Array
    factor: jax.Array


@dataclass(frozen=True, eq=False)
class PopulationModel:
    """A NumPyro model of what members share, and their density given it.

    :func:`population_model` makes it.

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

    def __call__(self) -> None:
        """Run the NumPyro program of median, sd and correlation, from their priors."""
        for name, prior in self.sampled_priors.items():
            numpyro.sample(name, prior)

    @cached_property
    def sampled_priors(self) -> dict[str, dist.Distribution]:
        """Prior of all that the population is, as NumPyro samples it."""
        priors = {f"{MEDIAN}[{k}]": standardised(self.median[k]) for k in self.shared}
        priors |= {f"{SD}[{k}]": standardised(self.spread[k]) for k in self.shared}
        if len(self.shared) > 1:
            priors[CHOLESKY] = dist.LKJCholesky(len(self.shared), concentration=self.eta)
        return priors

    @cached_property
    def unshared(self) -> dict[str, tuple[str, ...]]:
        """Unknowns that do not follow the population, by member."""
        return {
            member: tuple(name for name in model.sampled_priors if name not in self.shared)
            for member, model in self.members.items()
        }

    @cached_property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Both ends of the ranges, (k,) each, on the parameters' scales."""
        low, high = zip(*map(ends, self.shared.values()), strict=True)
        return np.array(low), np.array(high)

    def log_density(self, x: jax.Array, population: PopulationDraws) -> jax.Array:
        """Return the log density (...,) of members' shared unknowns ``x`` (..., k).

        ``x`` are on the parameters' scales; ``population`` is one draw.
        """
        mean, sd = self.means(population.median), population.sd

        def uncut() -> tuple[jax.Array, jax.Array]:
            return (x - mean) / sd, jnp.broadcast_to(sd, x.shape)

        def cut() -> tuple[jax.Array, jax.Array]:
            return to_score(x, mean, sd, *self.ends)

        low, high = self.ends
        far = jnp.all((mean - low > _FAR * sd) & (high - mean > _FAR * sd))
        q, slope = jax.lax.cond(far, uncut, cut)
        pivots, rows = eliminate(population.factor, jnp.eye(len(self.shared)))
        inverse = rows / pivots[:, None]
        z = jnp.einsum("kl,...l->...k", inverse, q)
        determinant = jnp.sum(jnp.log(pivots))
        return -0.5 * jnp.sum(z**2, axis=-1) - jnp.sum(jnp.log(slope), axis=-1) - determinant

    def shared_values(self, population: PopulationDraws, z: jax.Array) -> dict[str, jax.Array]:
        """Return shared unknowns by name, each (...), in their units.

        Parameters
        ----------
        population : one draw of it. z : standard normal scores (..., k).
        """
        q = jnp.einsum("kl,...l->...k", population.factor, z)
        x = from_score(q, self.means(population.median), population.sd, *self.ends)
        return {
            name: from_scale(parameter, x[..., k])
            for k, (name, parameter) in enumerate(self.shared.items())
        }

    def means(self, median: jax.Array) -> jax.Array:
        """Return the population's means (k,) on the parameters' scales."""
        return jnp.stack([to_scale(p, median[k]) for k, p in enumerate(self.shared.values())])


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
    median : the prior of the population's median, by shared name, in the parameter's unit; by
        default the first member's prior.
    spread : the prior of the population's sd on the parameter's scale (of the logarithm where that
        is logarithmic), by shared name; a number is the scale of a half-normal, by default half of
        the sd of the first member's prior.

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
    first = next(iter(members.values()))
    medians = {name: (median or {}).get(name, first.prior[name]) for name in parameters}
    spreads: dict[str, dist.Distribution] = {}
    for name, parameter in parameters.items():
        prior = (spread or {}).get(name)
        if prior is None:
            prior = _SCATTER * _sd_on_scale(parameter, first.prior[name])
        if not (isinstance(prior, dist.Distribution) or 0.0 < prior < math.inf):
            raise InputError(
                f"hierarchy: spread of '{name}' is {prior}; give a number above 0, or a "
                "distribution"
            )
        spreads[name] = prior if isinstance(prior, dist.Distribution) else dist.HalfNormal(prior)
    cut = truncated(medians, first.forward.scene)
    return PopulationModel(dict(members), parameters, cut, spreads, float(eta))


def _sd_on_scale(parameter: Parameter, prior: dist.Distribution) -> float:
    draws = prior.sample(jax.random.key(0), (_DRAWS,))
    return float(jnp.std(to_scale(parameter, draws)))


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
