"""A factor that serves other tangents: conjugate gradients preconditioned by it.

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

from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.protocol import Direct, Outcome
from emulator.fem.linear.suitesparse import keep_factors
from emulator.fem.loop import jit, while_loop

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

    For numbers, on meshes where a factorisation takes as long as many back-substitutions.

    pattern : upper triangle.
    """

    def __init__(self, direct: Direct, pattern: Pattern) -> None:
        self._pattern = pattern
        self._kept: jax.Array | None = None
        as_long = int(_STEPS_OF_LARGE * (pattern.size / _LARGE) ** (2.0 / 3.0))
        self._steps = max(_PATIENCE, as_long)
        program = (lambda function: function) if direct.on_host else jit
        self._product = jit(pattern.product)
        self._factorised = program(partial(direct.solve, pattern, definite=True))
        self._beside = program(self._conjugate_gradients)
        self.factorisations = 0

    @staticmethod
    def pays(pattern: Pattern) -> bool:
        """Whether the matrices are large enough."""
        return pattern.upper and pattern.size >= _LARGE

    def attempt(
        self, tangent: jax.Array, b: jax.Array, *, near: bool = True
    ) -> tuple[jax.Array, jax.Array]:
        """``x`` (f,) with ``K x = b``, and the outcome.

        near : whether the factor kept may serve; without, the tangent's own is made and kept.
        """
        if near and self._kept is not None:
            found = self._beside(tangent, self._kept, b)
            if bool(found.convex & (found.reduction <= TOLERANCE)):
                return found.x, jnp.asarray(Outcome.OK, jnp.int32)
        self._kept = None
        with keep_factors(1):  # two of such a mesh may not fit into memory
            x, outcome = jax.block_until_ready(self._factorised(tangent, b))
        self.factorisations += 1
        if int(outcome) == Outcome.OK:
            self._kept = tangent
        return x, outcome

    def _conjugate_gradients(self, tangent: jax.Array, kept: jax.Array, b: jax.Array) -> Gradients:
        def precondition(residual: jax.Array) -> jax.Array:
            return self._factorised(kept, residual)[0]

        product = partial(self._product, tangent)
        return conjugate_gradients(product, precondition, b, self._steps, TOLERANCE, _PATIENCE)


class Gradients(NamedTuple):
    """Where conjugate gradients ended.

    x : (f,). reduction : () of the residual, in the norm of the preconditioner. convex : () whether
    every direction had positive curvature.
    """

    x: jax.Array
    reduction: jax.Array
    convex: jax.Array


def conjugate_gradients(
    product: Callable[[jax.Array], jax.Array],
    precondition: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    steps: int,
    tolerance: float,
    patience: int | None = None,
) -> Gradients:
    """``x`` (f,) with ``product(x) = b``, after so many ``steps`` at most.

    tolerance : of the residual relative to ``b``, both in the norm of ``precondition``.
    patience : steps after which they are given up where the residual falls more slowly than
        ``steps`` allow; never by default.
    """
    first = precondition(b)
    begin = jnp.vdot(b, first)
    enough = tolerance**2 * begin

    def on_pace(k: jax.Array, size: jax.Array) -> jax.Array:
        allowed = begin * tolerance ** (k / steps)
        return jnp.array(True) if patience is None else (k < patience) | (size <= allowed)

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
    fell = jnp.sqrt(jnp.abs(state.size) / jnp.where(begin > 0.0, begin, 1.0))
    return Gradients(state.x, fell, state.convex & jnp.isfinite(state.size))
