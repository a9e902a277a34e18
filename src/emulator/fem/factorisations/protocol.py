"""What is asked of a factorisation."""

from __future__ import annotations

from typing import Protocol

import jax
import numpy as np

REFUSALS = (jax.errors.JaxRuntimeError, ValueError)
"""Exceptions of a factorisation that refuses its matrix. Timing decides: the first if JAX meets the
failure while waiting for the result, the second if the call itself fails. Both messages name the
library and the reason, "not positive definite" or "singular"."""


class Structure(Protocol):
    """Nonzeros of a sparse matrix, row by row.

    rows, columns : (nnz,) int32 position of each nonzero. size : number of rows.
    upper : whether only the upper triangle of a symmetric matrix is there.
    """

    @property
    def rows(self) -> np.ndarray: ...  # noqa: D102

    @property
    def columns(self) -> np.ndarray: ...  # noqa: D102

    @property
    def size(self) -> int: ...  # noqa: D102

    @property
    def upper(self) -> bool: ...  # noqa: D102

    def product(self, values: jax.Array, x: jax.Array) -> jax.Array:
        """``A x``, shape (size,)."""
        ...


class Factorisation(Protocol):
    """A direct solver.

    name : in the registry and on a :class:`~emulator.fem.assembly.System`.
    triangle : whether it wants the upper triangle where a matrix is symmetric.
    definite : whether it refuses a symmetric matrix that is not positive definite.
    on_host : whether it is called from Python where the numbers are known; inside ``jax.jit`` by a
    callback. The others are part of the compiled program.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def triangle(self) -> bool: ...  # noqa: D102

    @property
    def definite(self) -> bool: ...  # noqa: D102

    @property
    def on_host(self) -> bool: ...  # noqa: D102

    def check(self) -> None:
        """Raise :class:`InputError` where its library is not installed."""
        ...

    def solve(self, structure: Structure, values: jax.Array, rhs: jax.Array) -> jax.Array:
        """``x`` with ``A x = rhs``, (size,) or (size, k); differentiable, usable under ``vmap``.

        Raises one of :data:`REFUSALS` where it refuses the matrix.
        """
        ...
