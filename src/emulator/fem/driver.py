"""Newton's method driven from Python, each iteration with the cheapest factorisation that works.

CHOLMOD takes about half of UMFPACK's time on a ventricle and a fifth on a large cube, but raises on
an indefinite tangent, and inside ``jax.jit`` nothing can be done about that. Out here the iteration
is simply taken again with UMFPACK.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.newton import Newton, NewtonOptions, NewtonState, solution_of
from emulator.fem.solution import Solution, Status
from emulator.fem.sparse import REFUSALS

_MOST_PATIENCE = 8


@dataclass(frozen=True, eq=False)
class Driver:
    """The iterations of one scene, compiled one by one.

    definite, general : the same equations with CHOLMOD and with UMFPACK.
    """

    definite: System
    general: System
    options: NewtonOptions

    def solve(self, theta: jax.Array, start: jax.Array) -> Solution:
        """Equilibrium at ``theta`` (p,) from ``start`` (n, 3) mm.

        Raises
        ------
        jax.errors.JaxRuntimeError
            A tangent singular to the last bit.
        """
        state = self._begin(theta, start)
        definite, patience, wait = True, 1, 0
        while int(state.status) == Status.RUNNING:
            if definite:
                try:
                    state = jax.block_until_ready(self._definite_step(theta, state))
                    patience = 1
                    continue
                except REFUSALS as error:
                    if "not positive definite" not in str(error):
                        raise
                # Where the tangent has been indefinite for long, ask less often.
                wait, patience = patience, min(2 * patience, _MOST_PATIENCE)
                state = state.forget_tangent(self.general)
            state = jax.block_until_ready(self._general_step(theta, state))
            wait -= 1
            definite = wait <= 0
            if definite:
                state = state.forget_tangent(self.definite)
        return solution_of(state)

    @property
    def systems(self) -> tuple[System, ...]:
        """Both."""
        return self.definite, self.general

    def linearise(self, u: jax.Array, theta: jax.Array) -> tuple[System, jax.Array]:
        """The system that can factorise the tangent at ``u`` (n, 3), and that tangent (nnz,)."""
        tangent = self._definite_tangent(u, theta)
        try:
            # The factor is kept by the tangent's values: solving for nothing is not in vain.
            jax.block_until_ready(self._definite_trial(tangent))
        except REFUSALS as error:
            if "not positive definite" not in str(error):
                raise
            return self.general, self._general_tangent(u, theta)
        return self.definite, tangent

    @cached_property
    def _definite_tangent(self):  # noqa: ANN202
        return jax.jit(partial(_safe_tangent, self.definite))

    @cached_property
    def _general_tangent(self):  # noqa: ANN202
        return jax.jit(partial(_safe_tangent, self.general))

    @cached_property
    def _definite_trial(self):  # noqa: ANN202
        nothing = jnp.zeros(self.definite.pattern.size)
        return jax.jit(lambda tangent: self.definite.solve(tangent, nothing))

    @cached_property
    def _begin(self):  # noqa: ANN202 - jitted closures, private
        return jax.jit(lambda theta, start: Newton(self.definite, self.options, theta).begin(start))

    @cached_property
    def _definite_step(self):  # noqa: ANN202
        return jax.jit(partial(_step, self.definite, self.options))

    @cached_property
    def _general_step(self):  # noqa: ANN202
        return jax.jit(partial(_step, self.general, self.options))


def _step(
    system: System, options: NewtonOptions, theta: jax.Array, state: NewtonState
) -> NewtonState:
    return Newton(system, options, theta).step(state)


def _safe_tangent(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    return system.pattern.safe_values(system.tangent(u, theta))
