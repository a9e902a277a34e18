r"""The posterior's log density in unconstrained coordinates.

NumPyro maps every parameter's support to the real line, :math:`z = T(\theta)`, and adds the
logarithm of the Jacobian determinant of :math:`T^{-1}`. The density is built once a model; the data
is an argument, so that programs compiled for one data set serve others of its shape.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro.infer.util import initialize_model

from calibrate.statistical_model import Data, Model


class Density(NamedTuple):
    """A log density on real coordinates.

    log_density : (z (p,), data) -> ().
    constrain : (data, z (s, p)) -> draws by name, each (s,).
    dimension : p.
    """

    log_density: Callable[[jax.Array, Data], jax.Array]
    constrain: Callable[[Data, jax.Array], dict[str, jax.Array]]
    dimension: int


@lru_cache(maxsize=4)
def density_of(model: Model) -> Density:
    """The density of a model's posterior, up to a constant."""
    example = {name: np.zeros(shape) for name, shape in model.observe.shapes.items()}
    info = initialize_model(jax.random.key(0), model, model_args=(example,), dynamic_args=True)
    flat, unravel = ravel_pytree(info.param_info.z)

    def log_density(z: jax.Array, data: Data) -> jax.Array:
        return -info.potential_fn(data)(unravel(z))

    def constrain(data: Data, z: jax.Array) -> dict[str, jax.Array]:
        return info.postprocess_fn(data)(unravel(z))

    return Density(log_density, jax.jit(jax.vmap(constrain, (None, 0))), flat.size)


def named_draws(model: Model, data: Data, z: np.ndarray) -> dict[str, np.ndarray]:
    """Draws by parameter name, each (chains, draws), from ``z`` (chains, draws, p)."""
    named = density_of(model).constrain(data, jnp.asarray(z.reshape(-1, z.shape[-1])))
    return {name: np.asarray(named[name]).reshape(z.shape[:2]) for name in model.names}
