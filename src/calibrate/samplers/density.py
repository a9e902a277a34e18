r"""The posterior's log density in unconstrained coordinates.

NumPyro maps every parameter's support to the real line, :math:`z = T(\theta)`, and adds the
logarithm of the Jacobian determinant of :math:`T^{-1}`. The density is built once a model; the data
is an argument, so that programs compiled for one data set serve others of its shape.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import potential_energy

from calibrate.statistical_model import Data, Model
from emulator.core.machine import cores
from emulator.fem.campaign import at_once
from emulator.surrogates.fem import FEMForward
from emulator.surrogates.protocol import ForwardMap


class Target(Protocol):
    """The interface of a density that Markov chains sample.

    log_density : (z (p,), data) -> ().
    dimension : the number of coordinates, p.
    piloted : whether a pilot run straightens the density (:mod:`calibrate.samplers.transport`).
    at_once : the number of threads that may evaluate it at the same time.
    """

    @property
    def log_density(self) -> Callable[[jax.Array, Any], jax.Array]: ...  # noqa: D102

    @property
    def dimension(self) -> int: ...  # noqa: D102

    @property
    def piloted(self) -> bool: ...  # noqa: D102

    @property
    def at_once(self) -> int: ...  # noqa: D102

    def __hash__(self) -> int: ...


class Density(NamedTuple):
    """A log density on real coordinates.

    log_density : (z (p,), data) -> (); the sum of the next two.
    log_prior : (z (p,),) -> (); the log prior density of ``z``, which integrates to 1.
    log_likelihood : (z (p,), data) -> (); ``-inf`` where the forward map has no answer.
    prior_draw : (rng_key,) -> z (p,) from the prior.
    constrain : (z (s, p),) -> draws by name, each (s,).
    unconstrain : (draw by name, each ()) -> z (p,).
    names : the names of the coordinates, (p,), in their order.
    at_once : the number of threads that may evaluate it at the same time.
    """

    log_density: Callable[[jax.Array, Data], jax.Array]
    log_prior: Callable[[jax.Array], jax.Array]
    log_likelihood: Callable[[jax.Array, Data], jax.Array]
    prior_draw: Callable[[jax.Array], jax.Array]
    constrain: Callable[[jax.Array], dict[str, jax.Array]]
    unconstrain: Callable[[Mapping[str, jax.Array]], jax.Array]
    names: tuple[str, ...]
    at_once: int = 1

    @property
    def dimension(self) -> int:
        """Number of coordinates, p."""
        return len(self.names)

    @property
    def piloted(self) -> bool:
        """Whether a pilot run straightens the density: one coordinate has no other to depend on."""
        return self.dimension > 1


@lru_cache(maxsize=4)
def density_of(model: Model) -> Density:
    """Return the density of a model's posterior, up to a constant."""
    names = tuple(sorted(model.sampled_priors))
    transforms = {name: biject_to(model.sampled_priors[name].support) for name in names}
    example = {name: np.zeros(shape) for name, shape in model.observe.shapes.items()}
    # By name: the Jacobian of a coordinate is a site too, and counts as observed.
    hidden = _observed_sites(model, example)

    def coordinates(z: jax.Array) -> dict[str, jax.Array]:
        return dict(zip(names, z, strict=True))

    def log_density(z: jax.Array, data: Data) -> jax.Array:
        return -potential_energy(model, (data,), {}, coordinates(z))

    def log_prior(z: jax.Array) -> jax.Array:
        unobserved = handlers.block(model, hide=hidden)
        return -potential_energy(unobserved, (example,), {}, coordinates(z))

    def log_likelihood(z: jax.Array, data: Data) -> jax.Array:
        return model.map_log_likelihood(draw(z), data)

    def draw(z: jax.Array) -> dict[str, jax.Array]:
        return {name: transforms[name](value) for name, value in coordinates(z).items()}

    def prior_draw(rng_key: jax.Array) -> jax.Array:
        trace = handlers.trace(handlers.seed(model, rng_key)).get_trace()
        return unconstrain({name: trace[name]["value"] for name in names})

    def unconstrain(draw: Mapping[str, jax.Array]) -> jax.Array:
        return jnp.stack([transforms[name].inv(draw[name]) for name in names])

    return Density(
        log_density,
        log_prior,
        log_likelihood,
        prior_draw,
        jax.jit(jax.vmap(draw)),
        unconstrain,
        names,
        threads_for(model.forward),
    )


def threads_for(forward: ForwardMap) -> int:
    """Return the number of evaluations at once: one a core, fewer where FEM needs the memory."""
    return at_once(forward.simulator) if isinstance(forward, FEMForward) else cores()


@lru_cache(maxsize=4)
def tempered(density: Density, power: float) -> Density:
    """Return ``density`` with its likelihood to a power in (0, 1]: wider for a power below 1."""
    if power == 1.0:
        return density

    def log_density(z: jax.Array, data: Data) -> jax.Array:
        return density.log_prior(z) + power * density.log_likelihood(z, data)

    return density._replace(log_density=log_density)


def _observed_sites(model: Model, data: dict[str, np.ndarray]) -> list[str]:
    """Return the names of observed sites and of factors, without computing anything."""
    names: list[str] = []

    def trace() -> None:
        sites = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace(data)
        names.extend(name for name, site in sites.items() if site.get("is_observed", False))

    jax.eval_shape(trace)
    return names


def named_draws(model: Model, z: np.ndarray) -> dict[str, np.ndarray]:
    """Return draws by parameter name, each (chains, draws), from ``z`` (chains, draws, p)."""
    draws = density_of(model).constrain(jnp.asarray(z.reshape(-1, z.shape[-1])))
    return {name: np.asarray(draws[name]).reshape(z.shape[:2]) for name in model.names}
