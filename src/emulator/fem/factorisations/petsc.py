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

from emulator.fem.factorisations.mumps import Factor, petsc
from emulator.fem.factorisations.protocol import Structure


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
    """LDL^T where the matrix is symmetric, LU where not."""

    name: str
    definite: bool
    triangle = True
    on_host = True

    def check(self) -> None:
        """Raise :class:`InputError` where PETSc or MUMPS is missing."""
        petsc()

    def solve(self, structure: Structure, values: jax.Array, rhs: jax.Array) -> jax.Array:
        """``x`` with ``A x = rhs``, shape of ``rhs``; its columns one after the other."""
        if rhs.ndim == 2:
            one = partial(self.solve, structure, values)
            return jnp.stack([one(column) for column in rhs.T], axis=1)
        if not any(isinstance(x, jax.core.Tracer) for x in (values, rhs)):
            return jnp.asarray(self._numbers(structure, values, rhs, transposed=False))
        return jax.lax.custom_linear_solve(
            partial(structure.product, values),
            rhs,
            lambda _, b: self._callback(structure, values, b, transposed=False),
            lambda _, b: self._callback(structure, values, b, transposed=not structure.upper),
            symmetric=structure.upper,
        )

    def _callback(
        self, structure: Structure, values: jax.Array, b: jax.Array, *, transposed: bool
    ) -> jax.Array:
        return jax.pure_callback(
            partial(self._numbers, structure, transposed=transposed),
            jax.ShapeDtypeStruct(b.shape, b.dtype),
            jax.lax.stop_gradient(values),
            b,
            vmap_method="sequential",
        )

    def _numbers(
        self, structure: Structure, values: jax.Array, b: jax.Array, *, transposed: bool
    ) -> np.ndarray:
        with _LAST.lock:
            factor = _LAST.of(structure, np.asarray(values))
            if self.definite and factor.negative_eigenvalues():
                raise ValueError("petsc: matrix is not positive definite")
            return factor.solve(np.asarray(b), transposed=transposed)


PETSC = Petsc("petsc", definite=False)
PETSC_DEFINITE = Petsc("petsc_definite", definite=True)
