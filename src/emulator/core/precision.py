"""The project's one global switch: JAX in float64.

Sparse factorisation, Newton's method and likelihoods need float64, and the sparse solvers accept
nothing else. Importing :mod:`emulator` turns it on, once, here. Networks ask for float32
explicitly, so their speed is not affected.
"""

import jax
import jax.numpy as jnp

from emulator.core.errors import InputError

jax.config.update("jax_enable_x64", True)


def require_float64(what: str) -> None:
    """Raise :class:`InputError` where float64 is switched off; costs nothing inside ``jit``."""
    if jnp.result_type(float) != jnp.float64:
        raise InputError(
            f"{what} needs float64: leave jax_enable_x64 on, as importing emulator did"
        )
