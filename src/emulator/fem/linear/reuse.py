"""A factor that serves other tangents: conjugate gradients preconditioned by it.

On a large mesh a factorisation takes as long as many back-substitutions, and the tangents of
Newton's method, of one theta and the next, are alike. So conjugate gradients, preconditioned by the
Cholesky factor of one tangent, replace factorisations for as long as they are faster.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.compiled import Number, compiled, while_loop
from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.suitesparse import (
    Outcome,
    Solved,
    factor_and_solve,
    keeping_factors,
    on_all_cores,
)

_PATIENCE = 6  # iterations before conjugate gradients that converge too slowly are given up
_LEAST = 60_000  # unknowns from which a kept factor pays
# Unknowns at which so many iterations of conjugate gradients take as long as a factorisation by
# CHOLMOD; times grow as n^(4/3) and n^2.
_LARGE = 100_000
_ITERATIONS_OF_LARGE = 25

ACCURACY, OF_A_START = 0.01, 0.1
"""Relative residual to which a step is solved beside a kept factor; and that of a start's stresses.

docs/experiments.md, "Steps solved to one part in a hundred".
"""


class Gradients(NamedTuple):
    """The result of conjugate gradients.

    x : the solution, (f,). reduction : the relative residual (), in the preconditioner's norm.
    iterations : their number, ().
    convex : whether every direction had positive curvature, ().
    """

    x: jax.Array
    reduction: jax.Array
    iterations: jax.Array
    convex: jax.Array


class _GradientIterate(NamedTuple):
    k: jax.Array
    x: jax.Array
    residual: jax.Array
    direction: jax.Array
    size: jax.Array  # residual . preconditioned residual
    convex: jax.Array  # whether the last direction had positive curvature


def conjugate_gradients(
    product: Callable[[jax.Array], jax.Array],
    precondition: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    steps: int,
    tolerance: Number,
    patience: int | None = None,
) -> Gradients:
    """Solve ``product(x) = b`` for ``x`` (f,).

    steps : the largest number of iterations.
    tolerance : the largest residual relative to ``b``, both in the norm of ``precondition``.
    patience : the number of iterations after which they end as soon as the residual is larger than
        a constant rate to ``tolerance`` in ``steps`` allows; None never ends them for that.
    """
    first = precondition(b)
    begin = jnp.vdot(b, first)
    enough = tolerance**2 * begin

    def on_pace(k: jax.Array, size: jax.Array) -> jax.Array:
        allowance = begin * tolerance ** (k / steps)
        return jnp.array(True) if patience is None else (k < patience) | (size <= allowance)

    def step(state: _GradientIterate) -> _GradientIterate:
        image = product(state.direction)
        curvature = jnp.vdot(state.direction, image)
        convex = curvature > 0.0
        length = jnp.where(convex, state.size / curvature, 0.0)
        x = state.x + length * state.direction
        residual = state.residual - length * image
        preconditioned = precondition(residual)
        size = jnp.vdot(residual, preconditioned)
        direction = preconditioned + size / state.size * state.direction
        return _GradientIterate(state.k + 1, x, residual, direction, size, convex)

    def running(state: _GradientIterate) -> jax.Array:
        unfinished = (state.k < steps) & (state.size > enough) & state.convex
        return unfinished & on_pace(state.k, state.size)

    start = _GradientIterate(jnp.array(0), jnp.zeros_like(b), b, first, begin, jnp.array(True))
    state = while_loop(running, step, start)
    reduction = jnp.sqrt(jnp.abs(state.size) / jnp.where(begin > 0.0, begin, 1.0))
    convex = state.convex & jnp.isfinite(state.size)
    return Gradients(state.x, reduction, state.k, convex)


class KeptFactor:
    """Solves with definite tangents, one after the other, that keep a factor while it serves.

    Only for concrete numbers, on meshes where a factorisation takes as long as many
    back-substitutions.

    pattern : the pattern of the tangents, an upper triangle.
    """

    def __init__(self, pattern: Pattern) -> None:
        self._pattern = pattern
        self._factorised = jnp.zeros(0)  # the tangent that the kept factor belongs to
        self._serves = False  # whether the next tangent is worth a try with it
        affordable = int(_ITERATIONS_OF_LARGE * (pattern.size / _LARGE) ** (2.0 / 3.0))
        self._iterations = max(_PATIENCE, affordable)
        self._product = compiled(pattern.product)
        self._solve = compiled(partial(factor_and_solve, pattern, kind="definite"))
        self._solve_beside = compiled(self._conjugate_gradients)
        self.factorisations = 0

    @staticmethod
    def pays(pattern: Pattern) -> bool:
        """Return whether the matrices are large enough for a kept factor to save time."""
        return pattern.upper and pattern.size >= _LEAST

    def attempt(self, tangent: jax.Array, b: jax.Array, accuracy: Number) -> Solved:
        """Return ``x`` (f,) with ``K x = b``, and the outcome.

        accuracy : the largest residual relative to ``b``, in the norm of the inverse factorised
            tangent, that conjugate gradients may leave; 0 for a factor of ``tangent`` itself.
        """
        if self._serves and float(accuracy) > 0.0:
            solution = self._solve_beside(tangent, self._factorised, b, accuracy)
            # A factor that needs many iterations costs more, from step to step, than a new one.
            self._serves = int(solution.iterations) <= self._iterations // 2
            if bool(solution.convex & (solution.reduction <= accuracy)):
                return solution.x, jnp.asarray(Outcome.OK, jnp.int32)
        # Two factors of a large mesh may not fit into memory.
        with on_all_cores(b.size), keeping_factors(1):
            x, outcome = jax.block_until_ready(self._solve(tangent, b))
        self.factorisations += 1
        self._serves = int(outcome) == Outcome.OK
        if self._serves:
            self._factorised = tangent
        return x, outcome

    def _conjugate_gradients(
        self, tangent: jax.Array, factorised: jax.Array, b: jax.Array, accuracy: Number
    ) -> Gradients:
        def precondition(residual: jax.Array) -> jax.Array:
            return self._solve(factorised, residual)[0]

        product = partial(self._product, tangent)
        return conjugate_gradients(product, precondition, b, self._iterations, accuracy, _PATIENCE)
