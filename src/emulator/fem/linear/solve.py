"""Direct solves: what a solver provides, how a solve ends, and the order in which kinds are tried.

A symmetric tangent is factorised as positive definite first. Only where that factorisation is
refused does a general one follow, so that an unstable equilibrium has derivatives, too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import IntEnum
from functools import partial
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp

from emulator.fem.compiled import cond, one_by_one
from emulator.fem.linear.pattern import Pattern


class Outcome(IntEnum):
    """How a linear solve ended, as a number that compiled programs can carry.

    The solution is NaN unless the outcome is OK.
    """

    OK = 0
    INDEFINITE = 1  # not positive definite; a general factorisation may still solve
    SINGULAR = 2


Solved = tuple[jax.Array, jax.Array]
"""A solution x, (size,) or (size, k), and its :class:`Outcome`, int32 ()."""

Kind = Literal["definite", "general", "transposed"]
"""What is solved with: a matrix that must be positive definite, given by its upper triangle, or
else is INDEFINITE; any matrix; or the transpose of any."""


class Direct(ABC):
    """A direct solver.

    name : the name in the registry.
    on_host : whether Python calls the solver with concrete numbers, and programs under ``jax.jit``
        reach it by a callback. Other solvers are part of the compiled program.
    """

    name: ClassVar[str]
    on_host: ClassVar[bool] = False

    @abstractmethod
    def check(self) -> None:
        """Load the solver's library; :class:`InputError` where it is not installed."""

    @abstractmethod
    def solve(self, pattern: Pattern, values: jax.Array, rhs: jax.Array, kind: Kind) -> Solved:
        """Return ``x`` with ``A x = rhs``, and the outcome."""


def attempt(direct: Direct, pattern: Pattern, values: jax.Array, rhs: jax.Array) -> Solved:
    """Return ``x`` with ``A x = rhs`` and the outcome, without derivatives.

    A matrix stored as an upper triangle must be positive definite; no other factorisation is tried.
    """
    if not pattern.upper:
        return _solve_whole(direct, pattern, values, rhs, "general")
    return direct.solve(pattern, values, rhs, "definite")


def solve(direct: Direct, pattern: Pattern, values: jax.Array, rhs: jax.Array) -> jax.Array:
    """Return ``x`` with ``A x = rhs``, (size,) or (size, k); NaN where ``A`` is singular.

    The solution is differentiable in ``values`` and ``rhs``; ``vmap`` solves one after the other.
    """
    if direct.on_host and not any(isinstance(x, jax.core.Tracer) for x in (values, rhs)):
        return _solve_any(direct, pattern, values, rhs, "general")
    constant = jax.lax.stop_gradient(values)

    def solution(b: jax.Array, kind: Kind) -> jax.Array:
        return one_by_one(partial(_solve_any, direct, pattern, kind=kind))(constant, b)

    return jax.lax.custom_linear_solve(
        partial(pattern.product, values),
        rhs,
        lambda _, b: solution(b, "general"),
        lambda _, b: solution(b, "transposed"),
        symmetric=pattern.upper,
    )


def _solve_any(
    direct: Direct, pattern: Pattern, values: jax.Array, b: jax.Array, kind: Kind
) -> jax.Array:
    """Solve with any regular matrix: by a general factorisation where it is indefinite."""
    if not pattern.upper:
        return _solve_whole(direct, pattern, values, b, kind)[0]
    x, outcome = attempt(direct, pattern, values, b)
    general = partial(direct.solve, pattern, values, b, "general")
    return cond(outcome == Outcome.INDEFINITE, lambda: general()[0], lambda: x)


def _solve_whole(
    direct: Direct, pattern: Pattern, values: jax.Array, b: jax.Array, kind: Kind
) -> Solved:
    """Solve with a matrix stored with both triangles; return ``x`` and the outcome.

    At rest, and where unloading begins, such tangents are symmetric and definite of either sign: a
    Cholesky factor takes a sixth of the time (docs/experiments.md, "Unloading").
    """
    half = pattern.half

    def general() -> Solved:
        return direct.solve(pattern, values, b, kind)

    def symmetric() -> Solved:
        upper = half.sum(values)
        sign = jnp.sign(jnp.sum(jnp.where(half.rows == half.columns, upper, 0.0)))
        x, outcome = direct.solve(half, sign * upper, sign * b, "definite")
        return cond(outcome == Outcome.OK, lambda: (x, outcome), general)

    return cond(pattern.is_symmetric(values), symmetric, general)
