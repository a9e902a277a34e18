"""PETSc with MUMPS, an optional extra for meshes that SuiteSparse cannot hold.

Called from Python where the numbers are known. Inside ``jax.jit`` a callback leads to it, which
copies the matrix and keeps the program out of JAX's cache on disk.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem.linear.mumps import Factor, SingularMatrix, petsc
from emulator.fem.linear.protocol import Outcome, Structure


@dataclass
class _Last:
    """The one factor that is kept: it may take all of the memory."""

    factor: Factor | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)

    def of(self, structure: Structure, values: np.ndarray) -> Factor:
        """The factor of a matrix."""
        if self.factor is None or not self.factor.serves(structure):
            self.factor = None  # freed before another is made
            self.factor = Factor(structure)
        try:
            self.factor.factorise(values)
        except Exception:
            self.factor = None  # MUMPS cannot go on from a failure
            raise
        return self.factor


_LAST = _Last()


@dataclass(frozen=True)
class Petsc:
    """LDL^T where the matrix is symmetric, LU where not; inertia tells whether it is definite."""

    name = "petsc"
    on_host = True

    def check(self) -> None:
        """Raise :class:`InputError` where PETSc or MUMPS is missing."""
        petsc()

    def solve(
        self,
        structure: Structure,
        values: jax.Array,
        rhs: jax.Array,
        *,
        definite: bool,
        transposed: bool = False,
    ) -> tuple[jax.Array, jax.Array]:
        """By LDL^T, whose pivots must be positive where ``definite``, or LU."""
        transposed = transposed and not structure.upper
        numbers = partial(_numbers, structure, definite=definite, transposed=transposed)
        if not any(isinstance(x, jax.core.Tracer) for x in (values, rhs)):
            x, outcome = numbers(values, rhs)
            return jnp.asarray(x), jnp.asarray(outcome)
        shapes = jax.ShapeDtypeStruct(rhs.shape, rhs.dtype), jax.ShapeDtypeStruct((), jnp.int32)
        x, outcome = jax.pure_callback(numbers, shapes, values, rhs, vmap_method="sequential")
        return x, outcome


PETSC = Petsc()


def _numbers(
    structure: Structure, values: jax.Array, b: jax.Array, *, definite: bool, transposed: bool
) -> tuple[np.ndarray, np.int32]:
    columns = np.asarray(b)
    with _LAST.lock:
        try:
            factor = _LAST.of(structure, np.asarray(values))
        except SingularMatrix:
            return np.full(columns.shape, np.nan), np.int32(Outcome.SINGULAR)
        if definite and factor.negative_eigenvalues():
            return np.full(columns.shape, np.nan), np.int32(Outcome.INDEFINITE)
        solve = partial(factor.solve, transposed=transposed)
        if columns.ndim == 1:
            return solve(columns), np.int32(Outcome.OK)
        return np.stack([solve(each) for each in columns.T], axis=1), np.int32(Outcome.OK)
