"""What Newton's method carries from one iteration to the next."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from emulator.fem.solution import Solution, Status

# Relative residual below which a step is judged by the residual alone, and stress iterates hand
# over to Newton's method (docs/experiments.md, "Stresses as iterates").
NEAR = 0.05
# Relative residual above which the load stiffness is left out of the tangent
# (docs/experiments.md, "Fewer factorisations from rest").
UNBALANCED = 0.5


class Negligible(NamedTuple):
    """What floating point cannot tell from nothing, together: shape () in mN, and in mm.

    A residual alone may be so small and yet bend a slender body by metres.
    """

    residual: jax.Array
    correction: jax.Array


class NewtonState(NamedTuple):
    """What the next iteration needs.

    u : (n, 3) mm, current iterate. iterates : the formulation's own, or None.
    level : load level being solved. u_reached : (n, 3) mm, solution at ``reached``, the last level
    that converged. increment : of the load.
    at_level : iterations spent at this level. iterations, factorisations : all of them.
    residual : (f,) mN at ``u`` and ``level``, not yet evaluated while at_level is 0.
    error : the residual relative to the forces at work; inf until the supports are met.
    negligible : residual in mN, and correction of a node in mm, that may be round-off.
    tangent : (nnz,) mN/mm, the last one assembled. refresh : whether the next iteration needs a
    new one.
    convex : whether every step at this level was a full one, down the potential, with a positive
    definite tangent.
    careful : a level whose way is not convex is given up if its next increment would be this or
    more; inf for never.
    crushed : whether the last level was given up because elements would invert.
    singular : whether the last step came of a singular tangent.
    flattened : steps at this level shortened because elements would invert.
    status : a :class:`Status`.
    """

    u: jax.Array
    iterates: Any
    level: jax.Array
    u_reached: jax.Array
    reached: jax.Array
    increment: jax.Array
    at_level: jax.Array
    iterations: jax.Array
    factorisations: jax.Array
    residual: jax.Array
    error: jax.Array
    negligible: Negligible
    tangent: jax.Array
    refresh: jax.Array
    convex: jax.Array
    careful: jax.Array
    crushed: jax.Array
    singular: jax.Array
    flattened: jax.Array
    status: jax.Array

    @property
    def running(self) -> jax.Array:
        """Whether the iteration has not ended."""
        return self.status == Status.RUNNING

    @property
    def alone(self) -> bool:
        """Whether the displacement is all that is iterated."""
        return not jax.tree.leaves(self.iterates)

    def solution(self) -> Solution:
        """The result the iteration ended with."""
        converged = self.status == Status.CONVERGED
        return Solution(
            displacement=jnp.where(converged, self.u, self.u_reached),
            status=self.status,
            iterations=self.iterations,
            factorisations=self.factorisations,
            residual=self.error,
            load_reached=jnp.where(converged, 1.0, self.reached),
        )
