"""Correlation of Gaussian processes."""

from typing import Any

import jax.numpy as jnp


def matern32(squared: Any) -> Any:
    """Return Matern's correlation of smoothness 3/2 at squared scaled distances of any shape."""
    a = jnp.sqrt(3.0 * squared)
    return (1.0 + a) * jnp.exp(-a)
