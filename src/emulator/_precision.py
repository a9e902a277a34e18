"""The project's one global switch: JAX in float64.

Sparse factorisation, Newton's method and likelihoods need float64, and the sparse solvers accept
nothing else. Importing :mod:`emulator` turns it on, once, here. Networks ask for float32
explicitly, so their speed is not affected.
"""

import jax

jax.config.update("jax_enable_x64", True)
