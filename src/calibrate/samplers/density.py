r"""The posterior's log density in unconstrained coordinates.

NumPyro maps every parameter's support to the real line, :math:`z = T(\theta)`, and adds the
logarithm of the Jacobian determinant of :math:`T^{-1}`. The density is built once a model; the data
is an argument, so that programs compiled for one data set serve others of its shape.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import initialize_model, potential_energy

from calibrate.statistical_model import Data, Model


class Density(NamedTuple):
    """A log density on real coordinates.

    log_density : (z (p,), data) -> (); the sum of the next two.
    log_prior : (z (p,),) -> (); the prior's density of ``z``, which integrates to 1.
    log_likelihood : (z (p,), data) -> (); ``-inf`` where the forward map has no answer.
    prior_draw : (rng_key,) -> z (p,) from the prior.
    constrain : (data, z (s, p)) -> draws by name, each (s,).
    dimension : p.
    """

    log_density: Callable[[jax.Array, Data], jax.Array]
    log_prior: Callable[[jax.Array], jax.Array]
    log_likelihood: Callable[[jax.Array, Data], jax.Array]
    prior_draw: Callable[[jax.Array], jax.Array]
    constrain: Callable[[Data, jax.Array], dict[str, jax.Array]]
    dimension: int


@lru_cache(maxsize=4)
def density_of(model: Model) -> Density:
    """The density of a model's posterior, up to a constant."""
    example = {name: np.zeros(shape) for name, shape in model.observe.shapes.items()}
    info = initialize_model(jax.random.key(0), model, model_args=(example,), dynamic_args=True)
    flat, unravel = ravel_pytree(info.param_info.z)
    sites = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace(example)
    # By name: the Jacobian of a coordinate is a site too, and counts as observed.
    hidden = [name for name, site in sites.items() if _observed(site)]

    def log_density(z: jax.Array, data: Data) -> jax.Array:
        return -info.potential_fn(data)(unravel(z))

    def log_prior(z: jax.Array) -> jax.Array:
        unobserved = handlers.block(model, hide=hidden)
        return -potential_energy(unobserved, (example,), {}, unravel(z))

    def log_likelihood(z: jax.Array, data: Data) -> jax.Array:
        draw = info.postprocess_fn(data)(unravel(z))
        return sum_log_likelihood(trace_of(model, draw, data))

    def prior_draw(rng_key: jax.Array) -> jax.Array:
        trace = handlers.trace(handlers.seed(model, rng_key)).get_trace()
        sites = {name: trace[name] for name in info.param_info.z}
        z = {n: biject_to(site["fn"].support).inv(site["value"]) for n, site in sites.items()}
        return ravel_pytree(z)[0]

    def constrain(data: Data, z: jax.Array) -> dict[str, jax.Array]:
        return info.postprocess_fn(data)(unravel(z))

    return Density(
        log_density,
        log_prior,
        log_likelihood,
        prior_draw,
        jax.jit(jax.vmap(constrain, (None, 0))),
        flat.size,
    )


@lru_cache(maxsize=4)
def tempered(density: Density, power: float) -> Density:
    """``density`` with its likelihood to a power in (0, 1]: a wider posterior below 1."""
    if power == 1.0:
        return density

    def log_density(z: jax.Array, data: Data) -> jax.Array:
        return density.log_prior(z) + power * density.log_likelihood(z, data)

    return density._replace(log_density=log_density)


def trace_of(model: Model, draw: dict[str, jax.Array], data: Data) -> dict[str, Any]:
    """The model's sites at ``draw`` (a number by name) and ``data``, as NumPyro traces them."""
    return handlers.trace(handlers.substitute(model, data=draw)).get_trace(data)


def _observed(site: dict[str, Any]) -> bool:
    return bool(site.get("is_observed", False))


def sum_log_likelihood(trace: dict[str, Any]) -> jax.Array:
    """Log density of all that is observed, whether the forward map is valid included."""
    terms = [
        jnp.sum(site["fn"].log_prob(site["value"])) for site in trace.values() if _observed(site)
    ]
    return sum(terms, jnp.zeros(()))


def named_draws(model: Model, data: Data, z: np.ndarray) -> dict[str, np.ndarray]:
    """Draws by parameter name, each (chains, draws), from ``z`` (chains, draws, p)."""
    named = density_of(model).constrain(data, jnp.asarray(z.reshape(-1, z.shape[-1])))
    return {name: np.asarray(named[name]).reshape(z.shape[:2]) for name in model.names}
