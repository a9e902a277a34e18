r"""Elimination of small positive definite matrices in plain arithmetic, which may be batched.

:math:`M = L P L^T` with a unit lower triangular L and pivots :math:`P = \mathrm{diag}(p)`. Then
:math:`|M| = \prod_k p_k`, and with :math:`R = L^{-1} A`

.. math:: A^T M^{-1} A = R^T P^{-1} R .

Batched LAPACK calls on small matrices (``jax.vmap`` of ``jnp.linalg.solve``, ``inv``, ``det`` and
``cholesky``) have been seen to hang on processors of few cores, so they are not used here.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def eliminated(matrix: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the pivots p (r,) and the reduced rows R (r, m), by elimination without exchanges.

    matrix : the positive definite matrix M, (r, r).
    rows : A, (r, m).
    """
    later = jnp.arange(len(matrix))

    def step(
        state: tuple[jax.Array, jax.Array], k: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        M, R = state
        pivot, row = M[k, k], R[k]
        factor = jnp.where(later > k, M[:, k] / pivot, 0.0)
        return (M - factor[:, None] * M[k], R - factor[:, None] * row), (pivot, row)

    reduced: tuple[jax.Array, jax.Array] = jax.lax.scan(step, (matrix, rows), later)[1]
    return reduced
