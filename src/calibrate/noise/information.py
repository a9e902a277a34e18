"""What noise leaves data to say about its mean."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from calibrate.noise.protocol import Noise


def information_about_means(
    noise: Mapping[str, Noise], means: Mapping[str, jax.Array]
) -> jax.Array:
    """Information (d, d) of known noises about the data's means, in ``ravel_pytree``'s order."""
    flat, unravel = ravel_pytree(means)

    def log_density(moved: jax.Array) -> jax.Array:
        at = unravel(moved)
        terms = [noise[n].distribution(at[n], {}).log_prob(means[n]) for n in means]
        return sum(terms, jnp.zeros(()))

    return -jax.hessian(log_density)(flat)
