"""What is asked of a direct solver: a solution, and how the solve ended, as data."""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

import jax
import numpy as np


class Outcome(IntEnum):
    """How a linear solve ended, as a number that travels through ``jit``.

    Where it is not OK, the solution is NaN.
    """

    OK = 0
    INDEFINITE = 1  # not positive definite; a general factorisation may still solve
    SINGULAR = 2


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

    def both(self, values: jax.Array) -> tuple[np.ndarray, np.ndarray, jax.Array]:
        """Rows, columns and values with both triangles."""
        ...


class Direct(Protocol):
    """A direct solver.

    name : in the registry.
    on_host : whether it is called from Python where the numbers are known; inside ``jax.jit`` by a
        callback. The others are part of the compiled program.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def on_host(self) -> bool: ...  # noqa: D102

    def check(self) -> None:
        """Make its library ready; :class:`InputError` where it is not installed."""
        ...

    def solve(
        self,
        structure: Structure,
        values: jax.Array,
        rhs: jax.Array,
        *,
        definite: bool,
        transposed: bool = False,
    ) -> tuple[jax.Array, jax.Array]:
        """``x`` with ``A x = rhs``, (size,) or (size, k), and the :class:`Outcome`, int32 ().

        definite : INDEFINITE unless ``A``, its upper triangle given, is positive definite.
        transposed : solve with the transpose.
        """
        ...
