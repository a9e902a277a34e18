r"""The posterior's log density in unconstrained coordinates.

NumPyro maps every parameter's support to the real line, :math:`z = T(\theta)`, and adds the
logarithm of the Jacobian determinant of :math:`T^{-1}`. The density is built once a model; the data
is an argument, so that programs compiled for one data set serve others of its shape.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.util import potential_energy

from calibrate.statistical_model.many_draws import BATCH, batches, in_blocks, means_at
from calibrate.statistical_model.model import Data, Model
from emulator.core.kept import kept
from emulator.core.machine import cores
from emulator.fem.campaign import at_once
from emulator.surrogates.fem import FEMForward
from emulator.surrogates.protocol import ForwardMap

_MOST_PILOTED = 20  # coordinates; more have more bends than a pilot run can tell
_FARTHEST = 40.0  # |z| at which a bounded parameter is its bound in double precision


@dataclass(frozen=True)
class Target:
    """A log density on real coordinates that Markov chains sample.

    log_density : (z (p,), data) -> ().
    dimension : the number of coordinates, p.
    piloted : whether a pilot run straightens the density (:mod:`calibrate.importance.transport`).
    at_once : the number of threads that may evaluate it at the same time.
    whitened : whether chains run in coordinates that are white at a mode, in place of a pilot.
    """

    log_density: Callable[[jax.Array, Any], jax.Array]
    dimension: int
    piloted: bool
    at_once: int
    whitened: bool = field(default=False, kw_only=True)


@dataclass(frozen=True)
class Density(Target):
    """The posterior of a model; ``log_density`` is the sum of the next two.

    log_prior : (z (p,),) -> (); the log prior density of ``z``, which integrates to 1.
    log_likelihood : (z (p,), data) -> (); ``-inf`` where the forward map has no answer.
    prior_draw : (rng_key,) -> z (p,) from the prior.
    constrain : (z (s, p),) -> draws by name, each (s,).
    unconstrain : (draw by name, each ()) -> z (p,).
    names : the names of the coordinates, (p,), in their order.
    batches : whether many evaluations at once are cheap, as they are where none solves FEM.
    means : (z (s, p),) -> data without noise, (s, ...) by name, and validity (s,).
    around : (z (p,), means, validity, data) -> (); log_likelihood where both are known, if it can.
    """

    log_prior: Callable[[jax.Array], jax.Array]
    log_likelihood: Callable[[jax.Array, Data], jax.Array]
    prior_draw: Callable[[jax.Array], jax.Array]
    constrain: Callable[[jax.Array], dict[str, jax.Array]]
    unconstrain: Callable[[Mapping[str, jax.Array]], jax.Array]
    names: tuple[str, ...]
    batches: bool = True
    means: Callable[..., tuple[Any, np.ndarray]] = lambda z: ({}, np.ones(len(z), bool))
    around: Callable[..., jax.Array] | None = None


@kept
def density_of(model: Model) -> Density:
    """Return the density of a model's posterior, up to a constant."""
    names = tuple(sorted(model.sampled_priors))
    transforms = {name: biject_to(model.sampled_priors[name].support) for name in names}

    def coordinates(z: jax.Array) -> dict[str, jax.Array]:
        return dict(zip(names, z, strict=True))

    def log_density(z: jax.Array, data: Data) -> jax.Array:
        return -potential_energy(model, (data,), {}, coordinates(z))

    def log_prior(z: jax.Array) -> jax.Array:
        return -potential_energy(model.draw_unknowns, (), {}, coordinates(z))

    def log_likelihood(z: jax.Array, data: Data) -> jax.Array:
        return around(z, *model.predict(draw(z)), data)

    def around(z: jax.Array, means: Data, valid: jax.Array, data: Data) -> jax.Array:
        return jnp.where(valid, model.log_likelihood(draw(z), means, data), -jnp.inf)

    def draw(z: jax.Array) -> dict[str, jax.Array]:
        return {name: transforms[name](value) for name, value in coordinates(z).items()}

    def prior_draw(rng_key: jax.Array) -> jax.Array:
        return unconstrain(handlers.seed(model.draw_unknowns, rng_key)())

    def unconstrain(draw: Mapping[str, jax.Array]) -> jax.Array:
        return jnp.stack([transforms[name].inv(draw[name]) for name in names])

    constrain = jax.jit(jax.vmap(draw))
    return Density(
        log_density=log_density,
        dimension=len(names),
        piloted=1 < len(names) <= _MOST_PILOTED,  # one has no other to depend on
        at_once=threads_for(model.forward),
        whitened=len(names) > _MOST_PILOTED,
        log_prior=log_prior,
        log_likelihood=log_likelihood,
        prior_draw=prior_draw,
        constrain=constrain,
        unconstrain=unconstrain,
        names=names,
        batches=batches(model.forward),
        means=lambda z: means_at(model, constrain(z)),
        around=around,
    )


def threads_for(forward: ForwardMap) -> int:
    """Return the number of evaluations at once: one a core, fewer where FEM needs the memory."""
    return at_once(forward.simulator) if isinstance(forward, FEMForward) else cores()


class Heights(NamedTuple):
    """Log densities at points, each (s,), ``-inf`` where the density is zero.

    prior : the prior density of z, its Jacobian included. likelihood : the likelihood.
    """

    prior: Any
    likelihood: Any


def heights(density: Density, z: np.ndarray, data: Data) -> Heights:
    """Return the log densities at points z (s, p)."""
    return in_blocks(lambda block: height_program(density)(block, *density.means(block), data), z)


@kept
def height_program(density: Density) -> Callable[..., Heights]:
    """Return the program (z (s, p), means, validity, data) -> log densities, as ``means`` gives."""

    def many(z: jax.Array, means: Data, valid: jax.Array, data: Data) -> Heights:
        def one(at: tuple[jax.Array, Data, jax.Array]) -> Heights:
            known, z = density.around, at[0]
            likelihood = known(*at, data) if known else density.log_likelihood(z, data)
            return Heights(without_nan(density.log_prior(z)), without_nan(likelihood))

        return jax.lax.map(one, (z, means, valid), batch_size=BATCH)

    return jax.jit(many)


@kept
def _prior_program(density: Density) -> Callable[..., jax.Array]:
    return jax.jit(jax.vmap(lambda key: density.prior_draw(jax.random.wrap_key_data(key))))


def prior_draws(density: Density, rng_key: jax.Array, count: int) -> np.ndarray:
    """Return points z (count, p) drawn from the prior."""
    keys = jax.random.key_data(jax.random.split(rng_key, count))
    return finite_coordinates(in_blocks(_prior_program(density), np.asarray(keys)))


def without_nan(log_density: jax.Array) -> jax.Array:
    """Return ``log_density``, ``-inf`` where it is not finite."""
    return jnp.where(jnp.isfinite(log_density), log_density, -jnp.inf)


def finite_coordinates(z: jax.Array | np.ndarray) -> np.ndarray:
    """Return ``z`` with finite coordinates; a draw on a bound is at infinity."""
    return np.clip(np.nan_to_num(np.asarray(z), posinf=1e9, neginf=-1e9), -_FARTHEST, _FARTHEST)


def named_draws(model: Model, z: np.ndarray) -> dict[str, np.ndarray]:
    """Return draws by parameter name, each (chains, draws), from ``z`` (chains, draws, p)."""
    draws = density_of(model).constrain(jnp.asarray(z.reshape(-1, z.shape[-1])))
    return {name: np.asarray(draws[name]).reshape(z.shape[:2]) for name in model.names}
