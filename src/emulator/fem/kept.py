"""A factor that serves the tangents after it, and conjugate gradients beside it.

On a large mesh a factorisation takes as long as many back-substitutions, and the tangents of
Newton's method, of one theta and the next, are alike: so conjugate gradients, preconditioned by the
Cholesky factor of one of them, replace factorisations for as long as they are faster.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.factorisations import Factorisation
from emulator.fem.factorisations.suitesparse import CHOLMOD, remember_factors
from emulator.fem.programs import while_loop
from emulator.fem.sparse import Pattern

TOLERANCE = 1e-10  # of the residual, in the norm of the reference's inverse
_PATIENCE = 6  # steps after which half the pace that the last allowed step needs is asked for
# Unknowns from which conjugate gradients beside a factor beat a factorisation by CHOLMOD, and the
# steps that then take as long. Times grow as n^2 and n^(4/3) (studies/large_meshes).
_LARGE = 100_000
_STEPS_OF_LARGE = 25


class _State(NamedTuple):
    """Of conjugate gradients.

    x, residual, direction : (f,). size : residual . preconditioned residual. convex : whether the
    last direction had positive curvature.
    """

    k: jax.Array
    x: jax.Array
    residual: jax.Array
    direction: jax.Array
    size: jax.Array
    convex: jax.Array


class KeptFactor:
    """Solves with definite tangents, one after the other, that keep a factor while it serves.

    For numbers, on meshes where a factorisation takes as long as many back-substitutions. Two
    factors of such a mesh may not fit into memory, so the solver is told to remember one.

    pattern : upper triangle. definite : what factorises, and refuses any other matrix.
    """

    def __init__(self, pattern: Pattern, definite: Factorisation = CHOLMOD) -> None:
        remember_factors(1)
        self._pattern = pattern
        self._kept: jax.Array | None = None
        as_long = int(_STEPS_OF_LARGE * (pattern.size / _LARGE) ** (2.0 / 3.0))
        self._steps = max(_PATIENCE, as_long)
        jit = (lambda function: function) if definite.on_host else jax.jit
        self._product = jax.jit(pattern.product)
        self._factorised = jit(partial(definite.solve, pattern))
        self._beside = jit(self._conjugate_gradients)
        self.factorisations = 0

    @staticmethod
    def pays(pattern: Pattern) -> bool:
        """Whether the matrices are large enough."""
        return pattern.size >= _LARGE

    def solve(self, tangent: jax.Array, b: jax.Array, *, near: bool = True) -> jax.Array:
        """``x`` (f,) with ``K x = b``; raises one of ``REFUSALS`` where K is seen not definite.

        near : whether the factor kept may serve; without, the tangent's own is made and kept.
        """
        if near and self._kept is not None:
            x, is_solution = self._beside(tangent, self._kept, b)
            if bool(is_solution):
                return x
        x = jax.block_until_ready(self._factorised(tangent, b))
        self._kept = tangent
        self.factorisations += 1
        return x

    def _conjugate_gradients(
        self, tangent: jax.Array, kept: jax.Array, b: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        product, precondition = partial(self._product, tangent), partial(self._factorised, kept)
        return conjugate_gradients(product, precondition, b, self._steps, TOLERANCE)


def conjugate_gradients(
    product: Callable[[jax.Array], jax.Array],
    precondition: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    steps: int,
    tolerance: float,
) -> tuple[jax.Array, jax.Array]:
    """``x`` (f,) with ``product(x) = b``, and whether it is one, shape ().

    Given up early where the residual falls too slowly.

    tolerance : of the residual relative to ``b``, both in the norm of ``precondition``.
    """
    first = precondition(b)
    begin = jnp.vdot(b, first)
    enough = tolerance**2 * begin

    def on_pace(k: jax.Array, size: jax.Array) -> jax.Array:
        return (k < _PATIENCE) | (size <= begin * tolerance ** (k / steps))

    def step(state: _State) -> _State:
        image = product(state.direction)
        curvature = jnp.vdot(state.direction, image)
        convex = curvature > 0.0
        length = jnp.where(convex, state.size / curvature, 0.0)
        x = state.x + length * state.direction
        residual = state.residual - length * image
        next_ = precondition(residual)
        size = jnp.vdot(residual, next_)
        direction = next_ + size / state.size * state.direction
        return _State(state.k + 1, x, residual, direction, size, convex)

    def running(state: _State) -> jax.Array:
        going = (state.k < steps) & (state.size > enough) & state.convex
        return going & on_pace(state.k, state.size)

    start = _State(jnp.array(0), jnp.zeros_like(b), b, first, begin, jnp.array(True))
    state = while_loop(running, step, start)
    return state.x, state.convex & (state.size <= enough) & jnp.isfinite(state.size)
