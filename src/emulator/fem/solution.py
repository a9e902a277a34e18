"""The result of a simulation: a displacement, how the solve ended, and its residual."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import jax
import numpy as np

from emulator.core.errors import SolverError


class Status(IntEnum):
    """How a simulation ended."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    LOAD_LIMIT = 2
    INVALID_INPUT = 3
    SINGULAR_TANGENT = 4
    INVERTED_ELEMENT = 5
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

    def require_converged(self, what: str = "simulation") -> Solution:
        """Return itself, or raise :class:`~emulator.core.errors.SolverError` naming the failure."""
        status = np.atleast_1d(np.asarray(self.status)).ravel()
        failures = np.flatnonzero(status != Status.CONVERGED)
        if failures.size:
            load_factor = float(np.atleast_1d(np.asarray(self.load_reached)).ravel()[failures[0]])
            position = f" {failures[0]} of {status.size}" if status.size > 1 else ""
            raise SolverError(
                f"{what}{position}: {Status(int(status[failures[0]])).text} "
                f"(converged up to {100 * load_factor:.3g} % of it)"
            )
        return self
