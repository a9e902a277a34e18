"""The state of Newton's method, from one iteration to the next."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.solution import Solution, Status


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
