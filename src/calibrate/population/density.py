r"""The log density of a hierarchy on real coordinates, in which its members are independent.

NumPyro maps population and own unknowns to the real line, as of any model; the members' scores are
replaced by the coordinates of :mod:`calibrate.population.coordinates`, with their Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import potential_energy

from calibrate.population.coordinates import Cut, Information, scores_of
from calibrate.population.model import CHOLESKY, MEDIAN, SCORES, SD, HierarchicalModel
from calibrate.population.shared import ends, to_scale
from calibrate.samplers.density import threads_for
from calibrate.statistical_model import Data


class Observed(NamedTuple):
    """What a hierarchy is conditioned on.

    data : by member and observation; members that say nothing are missing.
    information : what the coordinates are made of; it does not change the posterior.
    """

    data: Mapping[str, Data]
    information: Information


class Population(NamedTuple):
    """Numbers of the population: each (k,), and the lower factor L (k, k) of its correlation."""

    median: jax.Array
    sd: jax.Array
    factor: jax.Array


class HierarchicalDensity(NamedTuple):
    """A log density on real coordinates; see :class:`calibrate.samplers.density.Target`.

    constrain : (z (s, p), information) -> population, scores (s, n, k), own unknowns by site (s,).
    values : (*population (s, ...), scores (s, ..., k)) -> shared unknowns by name (s, ...).
    """

    log_density: Callable[[jax.Array, Observed], jax.Array]
    constrain: Callable[[jax.Array, Information], tuple[Population, jax.Array, dict[str, Any]]]
    values: Callable[..., dict[str, jax.Array]]
    dimension: int
    at_once: int

    @property
    def piloted(self) -> bool:
        """No: the monomials of a transport map are too many, the members straightened already."""
        return False


@lru_cache(maxsize=4)
def density_of_hierarchy(model: HierarchicalModel) -> HierarchicalDensity:
    """The density of the posterior of all members, up to a constant."""
    sites = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace()
    sampled = {name: site for name, site in sites.items() if site["type"] == "sample"}
    transforms = {name: biject_to(site["fn"].support) for name, site in sampled.items()}
    example = {name: transforms[name].inv(site["value"]) for name, site in sampled.items()}
    flat, unravel = ravel_pytree(example)

    def population(values: Mapping[str, jax.Array]) -> Population:
        medians, sds = (
            jnp.stack([transforms[f"{role}[{k}]"](values[f"{role}[{k}]"]) for k in model.shared])
            for role in (MEDIAN, SD)
        )
        alone = CHOLESKY not in values
        factor = jnp.eye(1) if alone else transforms[CHOLESKY](values[CHOLESKY])
        return Population(medians, sds, factor)

    def scores(z: jax.Array, information: Information) -> Any:
        values = unravel(z)
        found = population(values)
        mean = [to_scale(p, found.median[k]) for k, p in enumerate(model.shared.values())]
        low, high = jnp.array([ends(parameter) for parameter in model.shared.values()]).T
        cut = Cut(jnp.stack(mean), found.sd, low, high, found.factor)
        drawn, height = scores_of(values[SCORES], information, cut)
        return {**values, SCORES: drawn}, found, height

    def log_density(z: jax.Array, observed: Observed) -> jax.Array:
        values, _, height = scores(z, observed.information)
        return height - potential_energy(model, (observed.data,), {}, values)

    def constrain(z: jax.Array, information: Information) -> Any:
        values, found, _ = scores(z, information)
        own = {
            f"{name}[{member}]": transforms[f"{name}[{member}]"](values[f"{name}[{member}]"])
            for member, names in model.own.items()
            for name in names
        }
        return found, values[SCORES], own

    return HierarchicalDensity(
        log_density,
        jax.jit(jax.vmap(constrain, in_axes=(0, None))),
        jax.jit(jax.vmap(model.shared_values)),
        int(np.size(flat)),
        min(threads_for(member.forward) for member in model.members.values()),
    )
