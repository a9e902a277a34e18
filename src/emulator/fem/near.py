r"""Solves with tangents that are close to one whose Cholesky factor is known.

Inside ``jax.jit`` CHOLMOD's refusal of an indefinite tangent cannot be caught, and UMFPACK takes
four times as long. But over a box of theta the tangents at equilibrium are much alike, so that
conjugate gradients on :math:`K x = b`, preconditioned by the Cholesky factor of one
:math:`K_\text{ref}`, reach round-off's neighbourhood in 5 to 15 steps, each a product with K and a
back-substitution. They stop, and UMFPACK begins, at a direction of no positive curvature and where
they are slow, as in the soft corner of a box. An answer is judged by its residual, so K need not be
definite for it to be right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.assembly import System
from emulator.fem.kept import TOLERANCE, conjugate_gradients

_STEPS = 25  # about as long as one factorisation by UMFPACK


@dataclass(frozen=True, eq=False)
class NearSolver:
    """Solves with tangents of ``general``.

    definite : the same equations with a factorisation that refuses indefinite tangents.
    reference : (nnz,) a positive definite tangent of ``definite``; None for ``general`` alone.
    """

    general: System
    definite: System
    reference: np.ndarray | None

    def solve(self, tangent: jax.Array, rhs: jax.Array) -> jax.Array:
        """``x`` (f,) with ``K x = rhs``, linear in ``rhs`` and differentiable in it."""
        if self.reference is None:
            return self.general.solve(tangent, rhs)
        return jax.lax.custom_linear_solve(
            partial(self.general.pattern.product, tangent),
            rhs,
            lambda _, b: self._one_by_one(tangent, b),
            symmetric=True,
        )

    @property
    def _one_by_one(self) -> Callable[[jax.Array, jax.Array], jax.Array]:
        """The solver, whose ``vmap`` takes system after system: both branches would run else."""
        alone = jax.custom_batching.custom_vmap(self._solve)

        @alone.def_vmap
        def together(size, batched, tangent, b):  # noqa: ANN001, ANN202
            tangent, b = (
                x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
                for x, is_batched in zip((tangent, b), batched, strict=True)
            )
            return jax.lax.map(lambda each: alone(*each), (tangent, b)), True

        return alone

    def _solve(self, tangent: jax.Array, b: jax.Array) -> jax.Array:
        reference = jnp.asarray(self.reference)
        found, is_solution = conjugate_gradients(
            partial(self.general.pattern.product, tangent),
            lambda residual: self.definite.solve(reference, residual),
            b,
            _STEPS,
            TOLERANCE,
        )
        return jax.lax.cond(is_solution, lambda: found, lambda: self.general.solve(tangent, b))
