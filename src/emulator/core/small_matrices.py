r"""Elimination of small symmetric matrices in plain arithmetic, which may be batched.

Elimination without exchanges factorises :math:`M = L P L^T` with a unit lower triangular L and
pivots :math:`P = \mathrm{diag}(p)`. Then :math:`|M| = \prod_k p_k`, and with :math:`R = L^{-1} A`

.. math:: A^T M^{-1} A = R^T P^{-1} R .

A matrix that may be indefinite is *modified*: each pivot is replaced, before it eliminates, by
:math:`\hat p_k = \max(|p_k|, 10^{-10} \max_{ij} |M_{ij}|)`. The factors are then those of a
positive definite matrix with a larger diagonal, :math:`\hat M = M + \mathrm{diag}(\hat p - p)`
(Gill and Murray 1974; Nocedal and Wright 2006, Section 3.4).

Batches of small systems do not go to LAPACK: ``jax.vmap`` of ``jnp.linalg.solve``, ``inv``, ``det``
and ``cholesky`` of small matrices has been seen to hang on processors of few cores.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

_FEW = 4  # rows up to which elimination is written out: a loop costs more than they do
_FLAT = 1e-10  # least pivot of a modified matrix, relative to the largest entry


def eliminate(
    matrix: jax.Array, rows: jax.Array, *, modify: bool = False
) -> tuple[jax.Array, jax.Array]:
    """Return the pivots p (r,) and the reduced rows R (r, m).

    matrix : the symmetric matrix M, (r, r); positive definite, unless it is modified.
    rows : A, (r, m).
    modify : whether pivots are made positive.
    """
    later = jnp.arange(len(matrix))
    least = _FLAT * jnp.max(jnp.abs(matrix))

    def step(
        state: tuple[jax.Array, jax.Array], k: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        M, R = state
        pivot, row = M[k, k], R[k]
        if modify:
            pivot = jnp.maximum(jnp.abs(pivot), least)
        factor = jnp.where(later > k, M[:, k] / pivot, 0.0)
        return (M - jnp.outer(factor, M[k]), R - jnp.outer(factor, row)), (pivot, row)

    reduced: tuple[jax.Array, jax.Array]
    reduced = jax.lax.scan(step, (matrix, rows), later, unroll=len(matrix) <= _FEW)[1]
    return reduced


def solve_modified(matrix: jax.Array, right: jax.Array) -> jax.Array:
    r"""Return the solution (r,) of :math:`\hat M x = b`, where M may be indefinite.

    matrix : the symmetric matrix M, (r, r). right : the right side b, (r,).
    """
    size = len(right)
    pivots, rows = eliminate(matrix, jnp.column_stack([jnp.eye(size), right]), modify=True)
    return rows[:, :size].T @ (rows[:, size] / pivots)
