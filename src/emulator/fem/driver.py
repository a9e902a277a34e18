"""The search for equilibrium driven from Python, each step with the cheapest factorisation.

CHOLMOD takes about half of UMFPACK's time on a ventricle and a fifth on a large cube, but raises on
an indefinite tangent, and inside ``jax.jit`` nothing can be done about that. Out here a refusal is
information: the route of :mod:`emulator.fem.loading_path` is not convex and is given up, and on the
last route the iteration is taken again with UMFPACK.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.loading_path import LoadingPath, PathState, Route
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution
from emulator.fem.sparse import REFUSALS

_MOST_PATIENCE = 8  # iterations with UMFPACK before CHOLMOD is asked again


@dataclass(frozen=True, eq=False)
class Driver:
    """The steps of one scene, compiled one by one.

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
        while bool(state.running) and int(state.route) < Route.CLIMB:
            step = self._ramp_step if bool(state.ramping) else self._definite_step
            after = _unless_refused(step, theta, state)
            state = self._give_up(theta, state) if after is None else after
        return self._climb(theta, state).newton.solution()

    def _climb(self, theta: jax.Array, state: PathState) -> PathState:
        """The end of the last route."""
        definite, patience, wait = True, 1, 0
        while bool(state.running):
            if definite:
                after = _unless_refused(self._definite_step, theta, state)
                if after is not None:
                    state, patience = after, 1
                    continue
                # Where the tangent has been indefinite for long, ask less often.
                wait, patience = patience, min(2 * patience, _MOST_PATIENCE)
                convex = jnp.array(False)
                state = _forget_tangent(state, self.general)
                state = state._replace(newton=state.newton._replace(convex=convex))
            state = jax.block_until_ready(self._general_step(theta, state))
            wait -= 1
            definite = wait <= 0 or int(state.newton.at_level) == 0  # a new level: ask anew
            if definite:
                state = _forget_tangent(state, self.definite)
        return state

    @property
    def systems(self) -> tuple[System, ...]:
        """Both systems."""
        return self.definite, self.general

    def linearise(self, u: jax.Array, theta: jax.Array) -> tuple[System, jax.Array]:
        """The system that can factorise the tangent at ``u`` (n, 3), and that tangent (nnz,)."""
        tangent = self._definite_tangent(u, theta)
        # The solver keeps the factor of these values: the trial's work is used again.
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
        return jax.jit(lambda theta, start: self._path(theta).begin(start))

    @cached_property
    def _give_up(self):  # noqa: ANN202
        return jax.jit(lambda theta, state: self._path(theta).give_up(state))

    @cached_property
    def _ramp_step(self):  # noqa: ANN202
        return jax.jit(lambda theta, state: self._path(theta).ramp_step(state))

    @cached_property
    def _definite_step(self):  # noqa: ANN202
        return jax.jit(lambda theta, state: self._path(theta).newton_step(state))

    @cached_property
    def _general_step(self):  # noqa: ANN202
        path = partial(LoadingPath, self.general, self.options)
        return jax.jit(lambda theta, state: path(theta).newton_step(state))

    def _path(self, theta: jax.Array) -> LoadingPath:
        return LoadingPath(self.definite, self.options, theta)


def _unless_refused(function: Callable[..., Any], *arguments: Any) -> Any:
    """Result of ``function``; ``None`` where CHOLMOD finds its tangent not positive definite."""
    try:
        return jax.block_until_ready(function(*arguments))
    except REFUSALS as error:
        if "not positive definite" not in str(error):
            raise
    return None


def _forget_tangent(state: PathState, system: System) -> PathState:
    return state._replace(newton=state.newton.forget_tangent(system))


def _safe_tangent(system: System, u: jax.Array, theta: jax.Array) -> jax.Array:
    return system.pattern.safe_values(system.tangent(u, theta))
