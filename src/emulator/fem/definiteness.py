r"""Whether a symmetric matrix is positive definite, asked of its inverse.

:math:`A` is positive definite if and only if :math:`A^{-1}` is. On Lanczos vectors
:math:`Q = (q_1, \dots, q_m)` of a random start, :math:`Q^T A^{-1} Q` is tridiagonal with entries
:math:`\alpha_k` and :math:`\beta_k`, and has the pivots

.. math::
    \delta_1 = \alpha_1, \qquad \delta_k = \alpha_k - \beta_{k-1}^2 / \delta_{k-1}.

One that is not positive proves :math:`A` indefinite: some x has :math:`x^T A^{-1} x \le 0`. The
other way round it is a test with probability, and a good one where a loading path loses its
stability: there an eigenvalue of :math:`A` passes through zero, and eigenvalues next to zero are
those of :math:`A^{-1}` that Lanczos vectors hold first.

Inside ``jax.jit`` CHOLMOD's refusal cannot be caught, and a callback to another factorisation would
keep the program out of JAX's compilation cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

# An indefinite tangent of a ventricle took 12 at most (docs/experiments.md, "A definiteness test
# without a callback").
STEPS = 20
_ROUND_OFF = 1e-14  # of the coupling of two Lanczos vectors, relative to their entries


class _State(NamedTuple):
    """basis : (m, n), zero beyond vector k. pivot, coupling : of the last step."""

    k: jax.Array
    basis: jax.Array
    pivot: jax.Array
    coupling: jax.Array


def inverse_is_positive(
    solve: Callable[[jax.Array], jax.Array], size: int, steps: int = STEPS
) -> jax.Array:
    """Whether ``steps`` Lanczos vectors find the symmetric ``solve`` positive definite, shape ().

    Parameters
    ----------
    solve : b (n,) -> A^-1 b (n,).
    size : n.
    """
    count = min(steps, size)
    first = jax.random.normal(jax.random.key(0), (size,))
    basis = jnp.zeros((count, size)).at[0].set(first / _norm(first))

    def step(state: _State) -> _State:
        k, basis, pivot, coupling = state
        image = solve(basis[k])
        along = jnp.vdot(basis[k], image)
        pivot = along - coupling**2 / pivot
        for _ in range(2):  # once leaves errors that grow
            image -= basis.T @ (basis @ image)
        coupling = _norm(image)
        # A matrix of few distinct eigenvalues has no further vector.
        coupling = jnp.where(coupling > _ROUND_OFF * jnp.abs(along), coupling, 0.0)
        following = jnp.where(coupling > 0.0, image / coupling, 0.0)
        return _State(k + 1, basis.at[k + 1].set(following, mode="drop"), pivot, coupling)

    def running(state: _State) -> jax.Array:
        return (state.k < count) & (state.pivot > 0.0) & (state.coupling > 0.0)

    start = _State(jnp.array(0), basis, jnp.array(jnp.inf), jnp.array(1.0))
    return jax.lax.while_loop(running, step, start).pivot > 0.0


def _norm(vector: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.vdot(vector, vector))
