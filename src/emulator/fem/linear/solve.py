"""Solves with a tangent: definite first, any other way where that is refused."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.protocol import Direct, Outcome
from emulator.fem.loop import cond, one_by_one


def attempt(
    direct: Direct, pattern: Pattern, values: jax.Array, rhs: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """``x`` with ``A x = rhs`` and the outcome, without a second try; no derivatives.

    A symmetric matrix has to be positive definite.
    """
    if not pattern.upper:
        return _both_triangles(direct, pattern, values, rhs, transposed=False)
    return direct.solve(pattern, values, rhs, definite=True)


def solve(direct: Direct, pattern: Pattern, values: jax.Array, rhs: jax.Array) -> jax.Array:
    """``x`` with ``A x = rhs``, (size,) or (size, k); NaN where ``A`` is singular.

    Linear in ``rhs`` and differentiable in it; ``vmap`` takes one after the other.
    """
    if direct.on_host and not any(isinstance(x, jax.core.Tracer) for x in (values, rhs)):
        return _any(direct, pattern, values, rhs, transposed=False)
    constant = jax.lax.stop_gradient(values)

    def solved(b: jax.Array, *, transposed: bool) -> jax.Array:
        return one_by_one(partial(_any, direct, pattern, transposed=transposed))(constant, b)

    return jax.lax.custom_linear_solve(
        partial(pattern.product, values),
        rhs,
        lambda _, b: solved(b, transposed=False),
        lambda _, b: solved(b, transposed=True),
        symmetric=pattern.upper,
    )


def _any(
    direct: Direct, pattern: Pattern, values: jax.Array, b: jax.Array, *, transposed: bool
) -> jax.Array:
    if not pattern.upper:
        return _both_triangles(direct, pattern, values, b, transposed=transposed)[0]
    x, outcome = attempt(direct, pattern, values, b)
    general = partial(direct.solve, pattern, values, b, definite=False)
    return cond(outcome == Outcome.INDEFINITE, lambda: general()[0], lambda: x)


def _both_triangles(
    direct: Direct, pattern: Pattern, values: jax.Array, b: jax.Array, *, transposed: bool
) -> tuple[jax.Array, jax.Array]:
    """``x`` and the outcome, of a matrix whose pattern has both triangles.

    At rest, and where unloading begins, such tangents are symmetric and definite of either sign: a
    Cholesky factor takes a sixth of the time (docs/experiments.md, "Unloading").
    """
    half = pattern.half

    def general() -> tuple[jax.Array, jax.Array]:
        return direct.solve(pattern, values, b, definite=False, transposed=transposed)

    def symmetric() -> tuple[jax.Array, jax.Array]:
        upper = half.sum(values)
        sign = jnp.sign(jnp.sum(jnp.where(half.rows == half.columns, upper, 0.0)))
        x, outcome = direct.solve(half, sign * upper, sign * b, definite=True)
        return cond(outcome == Outcome.OK, lambda: (x, outcome), general)

    return cond(pattern.is_symmetric(values), symmetric, general)
