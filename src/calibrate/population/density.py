r"""The log density of a population and its members on real coordinates.

NumPyro maps the population and own unknowns to the real line, as of any model; the members' scores
are replaced by the coordinates of :mod:`calibrate.population.coordinates`, in which the members are
independent, with their Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import potential_energy

from calibrate.population.coordinates import CutNormal, Information, scores_of
from calibrate.population.model import CHOLESKY, MEDIAN, SCORES, SD, PopulationModel, ends, to_scale
from calibrate.samplers.density import Target, threads_for
from calibrate.statistical_model import Data


class Conditions(NamedTuple):
    """The inputs of the posterior of a population.

    data : data by member and observation; members without data are missing.
    information : the information from which the coordinates are made; it does not change the
        posterior.
    """

    data: Mapping[str, Data]
    information: Information


class PopulationDraws(NamedTuple):
    """Median and sd (k,) of a population, and the lower factor L (k, k) of its correlation."""

    median: jax.Array
    sd: jax.Array
    factor: jax.Array


@dataclass(frozen=True)
class PopulationDensity(Target):
    """The posterior of a population.

    constrain : (z (s, p), information) -> population, scores (s, n, k), own unknowns by site (s,).
    values : (*population (s, ...), scores (s, ..., k)) -> shared unknowns by name (s, ...).
    """

    constrain: Callable[[jax.Array, Information], tuple[PopulationDraws, jax.Array, dict[str, Any]]]
    values: Callable[..., dict[str, jax.Array]]


@lru_cache(maxsize=4)
def density_of_population(model: PopulationModel) -> PopulationDensity:
    """Return the density of the posterior of population and members, up to a constant."""
    sites = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace()
    sampled = {name: site for name, site in sites.items() if site["type"] == "sample"}
    transforms = {name: biject_to(site["fn"].support) for name, site in sampled.items()}
    example = {name: transforms[name].inv(site["value"]) for name, site in sampled.items()}
    flat, unravel = ravel_pytree(example)

    def population_at(values: Mapping[str, jax.Array]) -> PopulationDraws:
        medians, sds = (
            jnp.stack([transforms[f"{role}[{k}]"](values[f"{role}[{k}]"]) for k in model.shared])
            for role in (MEDIAN, SD)
        )
        single = CHOLESKY not in values
        factor = jnp.eye(1) if single else transforms[CHOLESKY](values[CHOLESKY])
        return PopulationDraws(medians, sds, factor)

    def with_scores(z: jax.Array, information: Information) -> Any:
        values = unravel(z)
        population = population_at(values)
        mean = [to_scale(p, population.median[k]) for k, p in enumerate(model.shared.values())]
        low, high = jnp.array([ends(parameter) for parameter in model.shared.values()]).T
        cut = CutNormal(jnp.stack(mean), population.sd, low, high, population.factor)
        scores, log_determinant = scores_of(values[SCORES], information, cut)
        return {**values, SCORES: scores}, population, log_determinant

    def log_density(z: jax.Array, conditions: Conditions) -> jax.Array:
        values, _, log_determinant = with_scores(z, conditions.information)
        return log_determinant - potential_energy(model, (conditions.data,), {}, values)

    def constrain(z: jax.Array, information: Information) -> Any:
        values, population, _ = with_scores(z, information)
        own = {
            f"{name}[{member}]": transforms[f"{name}[{member}]"](values[f"{name}[{member}]"])
            for member, names in model.own.items()
            for name in names
        }
        return population, values[SCORES], own

    return PopulationDensity(
        log_density,
        dimension=int(np.size(flat)),
        piloted=False,  # a transport map has too many monomials; members are straight already
        at_once=min(threads_for(member.forward) for member in model.members.values()),
        constrain=jax.jit(jax.vmap(constrain, in_axes=(0, None))),
        values=jax.jit(jax.vmap(model.shared_values)),
    )
