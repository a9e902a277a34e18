"""The result of a simulation, and the state of Newton's method that leads to it."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.engine import Engine
from emulator.core.errors import SolverError
from emulator.scenes.forward_problem import ForwardProblem


class Status(IntEnum):
    """How a simulation ended."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    LOAD_LIMIT = 2
    INVALID_INPUT = 3
    SINGULAR_TANGENT = 4
    INVERTED_ELEMENT = 5
    FAILED = 6
    RUNNING = 9

    @property
    def text(self) -> str:
        """The status in words, one line."""
        return _TEXT[self]


_TEXT = {
    Status.CONVERGED: "converged",
    Status.ITERATION_LIMIT: "iteration limit reached",
    Status.LOAD_LIMIT: "load limit reached: no equilibrium found at the full load",
    Status.INVALID_INPUT: "theta or the starting displacement is not finite",
    Status.SINGULAR_TANGENT: "singular tangent: stiffness vanishes or the supports are too few",
    Status.INVERTED_ELEMENT: "an element would invert: no admissible state found at the full load",
    Status.FAILED: "the external solver failed",
    Status.RUNNING: "still running",
}


class Solution(NamedTuple):
    """The result of a simulation; every field gains leading axes under ``vmap``.

    displacement : the displacement, (n, 3) mm; when not converged, the one at ``load_reached``.
    status : the outcome of the solve, a :class:`Status` as an integer.
    iterations : the iterations of Newton's method and of the stress iterates, over all fallbacks
        and load levels.
    factorisations : the tangents assembled; the other iterations kept the last one. Each is
        factorised, except on a large mesh where the factor of another serves
        (:class:`emulator.fem.linear.reuse.KeptFactor`).
    residual : the norm of the residual relative to the internal and external forces.
    load_reached : the largest fraction of the load with a converged solution.
    """

    displacement: jax.Array
    status: jax.Array
    iterations: jax.Array
    factorisations: jax.Array
    residual: jax.Array
    load_reached: jax.Array

    @property
    def converged(self) -> jax.Array:
        """Whether each status is CONVERGED; bool of the status' shape."""
        return self.status == Status.CONVERGED

    def require_converged(self, what: str = "simulation", limit: str | None = None) -> Solution:
        """Return itself, or raise :class:`~emulator.core.errors.SolverError` naming the failure.

        what : the name of the solve in the message.
        limit : the words for how far it came, for numbers of one solve.
        """
        status = np.atleast_1d(np.asarray(self.status)).ravel()
        failures = np.flatnonzero(status != Status.CONVERGED)
        if failures.size:
            load_factor = float(np.atleast_1d(np.asarray(self.load_reached)).ravel()[failures[0]])
            position = f" {failures[0]} of {status.size}" if status.size > 1 else ""
            limit = limit or f"converged up to {100 * load_factor:.3g} % of it"
            raise SolverError(
                f"{what}{position}: {Status(int(status[failures[0]])).text} ({limit})"
            )
        return self


class EquilibriumSolver(Protocol):
    """What solves a scene or a specimen: a simulator, or the map of a specimen's states.

    scene : the scene or the specimen that is solved.
    engine : the engine that does many solves; None for threads of this process.
    """

    @property
    def scene(self) -> ForwardProblem: ...  # noqa: D102

    @property
    def engine(self) -> Engine | None: ...  # noqa: D102

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) in mm; :class:`SolverError` when it does not converge."""
        ...

    def solve(self, theta: jax.Array, start: jax.Array | None = None) -> Solution:
        """Return the equilibrium at ``theta`` (p,), sought from ``start`` (n, 3) mm if given."""
        ...

    def sensitivities(self, u: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the derivatives (p, n, 3) of the equilibrium ``u`` (n, 3) mm in ``theta``."""
        ...

    def is_stable(self, u: jax.Array, theta: jax.Array) -> bool | None:
        """Return whether the equilibrium ``u`` (n, 3) mm is a minimum of the energy, if known."""
        ...


class RoundOff(NamedTuple):
    """A residual () in mN and a correction () in mm that together may be round-off.

    A residual alone may be as small and still bend a slender body by metres.
    """

    residual: jax.Array
    correction: jax.Array


class LoadHistory(NamedTuple):
    """The progress along the loading path.

    u : the displacement (n, 3) in mm at the last converged load factor ``load``.
    increment : the load increment.
    largest_indefinite : the largest load increment that is still tried after an indefinite tangent;
        larger ones end the load level. Infinite: every increment is.
    iterations : the iterations at this load level.
    monotone : whether every step at this level was a full one, down the potential, with a positive
        definite tangent.
    inversions : the steps at this level that inverting elements shortened.
    inverted : whether inverting elements ended the last level that was given up.
    singular : whether the last step came of a singular tangent.
    """

    u: jax.Array
    load: jax.Array
    increment: jax.Array
    largest_indefinite: jax.Array
    iterations: jax.Array
    monotone: jax.Array
    inversions: jax.Array
    inverted: jax.Array
    singular: jax.Array


class NewtonState(NamedTuple):
    """The state that the next iteration needs.

    u : the displacement, (n, 3) mm.
    auxiliary : the formulation's other unknowns, or None.
    load : the load factor that is being solved for.
    residual : the residual (f,) in mN at ``u`` and ``load``; not evaluated before a level's first
        iteration.
    relative_residual : the norm relative to the forces; infinite until the prescribed displacements
        are met.
    round_off : the residual and correction that may be round-off.
    tangent : the last tangent, (nnz,) mN/mm.
    renew : whether the next iteration assembles a new tangent.
    iterations, factorisations : the total numbers of both.
    history : the progress along the loading path.
    status : a :class:`Status`.
    """

    u: jax.Array
    auxiliary: Any
    load: jax.Array
    residual: jax.Array
    relative_residual: jax.Array
    round_off: RoundOff
    tangent: jax.Array
    renew: jax.Array
    iterations: jax.Array
    factorisations: jax.Array
    history: LoadHistory
    status: jax.Array

    @property
    def running(self) -> jax.Array:
        """Whether the iteration has not ended."""
        return self.status == Status.RUNNING

    @property
    def displacement_only(self) -> bool:
        """Whether the displacement is the only unknown."""
        return not jax.tree.leaves(self.auxiliary)

    def solution(self) -> Solution:
        """Return the result the iteration ended with."""
        converged = self.status == Status.CONVERGED
        return Solution(
            displacement=jnp.where(converged, self.u, self.history.u),
            status=self.status,
            iterations=self.iterations,
            factorisations=self.factorisations,
            residual=self.relative_residual,
            load_reached=jnp.where(converged, 1.0, self.history.load),
        )
