"""Newton's method driven from Python, each iteration with the cheapest factorisation that works.

CHOLMOD takes about half of UMFPACK's time on a ventricle and a fifth on a large cube, but raises on
an indefinite tangent, and inside ``jax.jit`` nothing can be done about that. Out here the iteration
is simply taken again with UMFPACK. From far away the stresses are iterates of their own
(:mod:`emulator.fem.mip`) until the residual is small or that fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.mip import MipNewton, MipState, applies
from emulator.fem.newton import NEAR, UNBALANCED, Newton, NewtonState, solution_of
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution, Status
from emulator.fem.sparse import REFUSALS

_MOST_PATIENCE = 8
_TENTH = 0.1  # of the load, where the ramps are lost and the loading path is followed
_CARRIED = 0.9  # relative residual below which a level of load is carried well enough to go up


class _Ramp(NamedTuple):
    """Load levels that stress iterates climb, a step or more on each."""

    first: float
    increment: float
    steps: int


# The first takes ventricles from rest to all but their softest corners, in four to six steps: with
# the whole load at once one in three is lost. The last is for beams that turn.
_RAMPS = (_Ramp(0.5, 0.25, 12), _Ramp(0.25, 0.125, 20), _Ramp(0.1, 0.1, 40))
_WHOLE = _Ramp(1.0, 0.0, 8)  # for a start that balances about half of the load or more


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
        if int(state.status) == Status.RUNNING and self._far(state):
            state = self._brought_near(theta, state)
        definite, patience, wait = True, 1, 0
        while int(state.status) == Status.RUNNING:
            if definite:
                after = _unless_refused(self._definite_step, theta, state)
                if after is not None:
                    state, patience = after, 1
                    continue
                # Where the tangent has been indefinite for long, ask less often.
                wait, patience = patience, min(2 * patience, _MOST_PATIENCE)
                state = state.forget_tangent(self.general)
            state = jax.block_until_ready(self._general_step(theta, state))
            wait -= 1
            definite = wait <= 0
            if definite:
                state = state.forget_tangent(self.definite)
        return solution_of(state)

    def _far(self, state: NewtonState) -> bool:
        """Whether the way is long, its supports in place, and stresses can be iterates."""
        wanted = self.options.stress_iterates and self.options.increment == 1.0
        far = NEAR < float(state.error) < float("inf")
        return wanted and far and applies(self.definite)

    def _brought_near(self, theta: jax.Array, state: NewtonState) -> NewtonState:
        """``state`` moved close to equilibrium, if so; steps are counted.

        If not, a start that loads hardly balance is left at the foot of its load.
        """
        from_rest = float(state.error) > UNBALANCED
        if from_rest and not self.definite.scene.held_displacement.any():
            state = self._begin(theta, jnp.zeros_like(state.u))  # no worse, and on the loading path
        spent, found = 0, None
        for ramp in _RAMPS if from_rest else (_WHOLE,):
            found, steps = self._climbed(ramp, theta, state.u, from_rest)
            spent += steps
            if found is not None:
                state = self._begin(theta, found)
                break
        if found is None and from_rest:
            # Bodies so soft have several equilibria: take the one that loading leads to.
            state = state._replace(level=jnp.array(_TENTH), increment=jnp.array(_TENTH))
        return state._replace(iterations=jnp.array(spent), factorisations=jnp.array(spent))

    def _climbed(
        self, ramp: _Ramp, theta: jax.Array, start: jax.Array, from_rest: bool
    ) -> tuple[jax.Array | None, int]:
        """Displacement (n, 3) near equilibrium, if the ``ramp`` leads there; and its steps."""
        state, level = self._begin_mip(theta, start), ramp.first
        for step in range(ramp.steps):
            # Loads that nothing balances yet lend no stiffness, as in Newton's method.
            stiffening = 0.0 if from_rest and step == 0 else level
            after = _unless_refused(self._mip_step, theta, level, stiffening, state)
            if after is None or not (float(after.fraction) > 0.0 and jnp.isfinite(after.error)):
                return None, step + 1
            state = after
            if level == 1.0 and float(state.error) <= NEAR:
                return state.u, step + 1
            if float(state.error) < _CARRIED:
                level = min(1.0, level + ramp.increment)
        return None, ramp.steps

    @property
    def systems(self) -> tuple[System, ...]:
        """Both."""
        return self.definite, self.general

    def linearise(self, u: jax.Array, theta: jax.Array) -> tuple[System, jax.Array]:
        """The system that can factorise the tangent at ``u`` (n, 3), and that tangent (nnz,)."""
        tangent = self._definite_tangent(u, theta)
        # The factor is kept by the tangent's values: solving for nothing is not in vain.
        if _unless_refused(self._definite_trial, tangent) is None:
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
    def _begin_mip(self):  # noqa: ANN202
        system, shrink = self.definite, self.options.shrink
        return jax.jit(lambda theta, u: MipNewton(system, shrink, theta, jnp.array(1.0)).begin(u))

    @cached_property
    def _mip_step(self):  # noqa: ANN202
        system, shrink = self.definite, self.options.shrink

        def step(
            theta: jax.Array, level: jax.Array, stiffening: jax.Array, state: MipState
        ) -> MipState:
            return MipNewton(system, shrink, theta, level).step(state, stiffening)

        return jax.jit(step)

    @cached_property
    def _definite_step(self):  # noqa: ANN202
        return jax.jit(partial(_step, self.definite, self.options))

    @cached_property
    def _general_step(self):  # noqa: ANN202
        return jax.jit(partial(_step, self.general, self.options))


def _unless_refused(function: Callable[..., Any], *arguments: Any) -> Any:
    """What ``function`` returns; ``None`` where CHOLMOD finds its tangent not positive definite."""
    try:
        return jax.block_until_ready(function(*arguments))
    except REFUSALS as error:
        if "not positive definite" not in str(error):
            raise
    return None


def _step(
    system: System, options: NewtonOptions, theta: jax.Array, state: NewtonState
) -> NewtonState:
    return Newton(system, options, theta).step(state)


def _safe_tangent(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    return system.pattern.safe_values(system.tangent(u, theta))
