"""The search for equilibrium driven from Python, each step with the cheapest factorisation.

A *definite* factorisation, CHOLMOD, is asked first and a *general* one, UMFPACK, where it refuses.

CHOLMOD takes about half of UMFPACK's time on a ventricle and a fifth on a large cube, but raises on
an indefinite tangent, and inside ``jax.jit`` nothing can be done about that. Out here a refusal is
information: the route of :mod:`emulator.fem.loading_path` is not convex and is given up, and on the
last route the iteration is taken again with UMFPACK.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from emulator.fem.assembly import System
from emulator.fem.factorisations import REFUSALS
from emulator.fem.loading_path import LoadingPath, PathState, Route
from emulator.fem.options import NewtonOptions
from emulator.fem.solution import Solution

_MOST_PATIENCE = 8  # iterations with UMFPACK before CHOLMOD is asked again


@dataclass(frozen=True, eq=False)
class Driver:
    """The steps of one scene, put together from compiled programs.

    definite, general : the same equations with a factorisation that refuses indefinite tangents,
    e.g. CHOLMOD, and with one that takes any, e.g. UMFPACK.
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
        state = self._path(theta).begin(start)
        while bool(state.running) and int(state.route) < Route.CLIMB:
            step = self.ramp_step if bool(state.ramping) else self.definite_step
            after = _unless_refused(step, theta, state)
            state = self._path(theta).give_up(state) if after is None else after
        return self._climb(theta, state).newton.solution()

    def _climb(self, theta: jax.Array, state: PathState) -> PathState:
        """The end of the last route."""
        definite, patience, wait = True, 1, 0
        while bool(state.running):
            if definite:
                after = _unless_refused(self.definite_step, theta, state)
                if after is not None:
                    state, patience = after, 1
                    continue
                # Where the tangent has been indefinite for long, ask less often.
                wait, patience = patience, min(2 * patience, _MOST_PATIENCE)
                convex = jnp.array(False)
                state = _forget_tangent(state, self.general)
                state = state._replace(newton=state.newton._replace(convex=convex))
            state = jax.block_until_ready(self.general_step(theta, state))
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
        tangent, _ = self.definite.safe_tangent(u, theta, 1.0)
        # The solver keeps the factor of these values: the trial's work is used again.
        if _unless_refused(_trial, self.definite, tangent) is None:
            return self.general, self.general.safe_tangent(u, theta, 1.0)[0]
        return self.definite, tangent

    def ramp_step(self, theta: jax.Array, state: PathState) -> PathState:
        """A step of the stress iterates."""
        return self._path(theta).ramp_step(state)

    def definite_step(self, theta: jax.Array, state: PathState) -> PathState:
        """An iteration of Newton's method with the definite factorisation."""
        return self._path(theta).newton_step(state)

    def general_step(self, theta: jax.Array, state: PathState) -> PathState:
        """An iteration of Newton's method with the general factorisation."""
        return LoadingPath(self.general, self.options, theta).newton_step(state)

    def _path(self, theta: jax.Array) -> LoadingPath:
        return LoadingPath(self.definite, self.options, theta)


def _trial(system: System, tangent: jax.Array) -> jax.Array:
    """The factorisation alone."""
    return system.solve(tangent, jnp.zeros(system.pattern.size))


def _unless_refused(function: Callable[..., Any], *arguments: Any) -> Any:
    """Result of ``function``; ``None`` where its tangent is found not positive definite."""
    try:
        return jax.block_until_ready(function(*arguments))
    except REFUSALS as error:
        if "not positive definite" not in str(error):
            raise
    return None


def _forget_tangent(state: PathState, system: System) -> PathState:
    return state._replace(newton=state.newton.forget_tangent(system))
