"""Direct solves, and the order in which kinds of factors are tried.

A symmetric tangent is factorised as positive definite first. Only where that factorisation is
refused does a general one follow, so that an unstable equilibrium has derivatives, too.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from emulator.fem.compiled import cond, one_by_one
from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.suitesparse import Kind, Outcome, Solved, factor_and_solve


def attempt(pattern: Pattern, values: jax.Array, rhs: jax.Array) -> Solved:
    """Return ``x`` with ``A x = rhs`` and the outcome, without derivatives.

    A matrix stored as an upper triangle must be positive definite; no other factorisation is tried.
    """
    if not pattern.upper:
        return _solve_whole(pattern, values, rhs, "general")
    return factor_and_solve(pattern, values, rhs, "definite")


def solve(pattern: Pattern, values: jax.Array, rhs: jax.Array) -> jax.Array:
    """Return ``x`` with ``A x = rhs``, (size,) or (size, k); NaN where ``A`` is singular.

    The solution is differentiable in ``values`` and ``rhs``; ``vmap`` solves one after the other.
    """
    constant = jax.lax.stop_gradient(values)

    def solution(b: jax.Array, kind: Kind) -> jax.Array:
        return one_by_one(partial(_solve_any, pattern, kind=kind))(constant, b)

    return jax.lax.custom_linear_solve(
        partial(pattern.product, values),
        rhs,
        lambda _, b: solution(b, "general"),
        lambda _, b: solution(b, "transposed"),
        symmetric=pattern.upper,
    )


def _solve_any(pattern: Pattern, values: jax.Array, b: jax.Array, kind: Kind) -> jax.Array:
    """Solve with any regular matrix: by a general factorisation where it is indefinite."""
    if not pattern.upper:
        return _solve_whole(pattern, values, b, kind)[0]
    x, outcome = attempt(pattern, values, b)
    general = partial(factor_and_solve, pattern, values, b, "general")
    return cond(outcome == Outcome.INDEFINITE, lambda: general()[0], lambda: x)


def _solve_whole(pattern: Pattern, values: jax.Array, b: jax.Array, kind: Kind) -> Solved:
    """Solve with a matrix stored with both triangles; return ``x`` and the outcome.

    At rest, and where unloading begins, such tangents are symmetric and definite of either sign: a
    Cholesky factor takes a sixth of the time (docs/experiments.md, "Unloading").
    """
    half = pattern.half

    def general() -> Solved:
        return factor_and_solve(pattern, values, b, kind)

    def symmetric() -> Solved:
        upper = half.sum(values)
        sign = jnp.sign(jnp.sum(jnp.where(half.rows == half.columns, upper, 0.0)))
        x, outcome = factor_and_solve(half, sign * upper, sign * b, "definite")
        return cond(outcome == Outcome.OK, lambda: (x, outcome), general)

    return cond(pattern.is_symmetric(values), symmetric, general)
