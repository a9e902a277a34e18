"""SuiteSparse through sparsax, inside compiled programs.

CHOLMOD for positive definite matrices, UMFPACK for any. CHOLMOD raises on an indefinite matrix,
even inside ``jit``, so callers who choose it must know that theirs is definite, or catch
:data:`~emulator.fem.factorisations.protocol.REFUSALS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import sparsax
from threadpoolctl import ThreadpoolController

from emulator.fem.factorisations.protocol import Structure


# By default sparsax caches up to 32 UMFPACK and 8 CHOLMOD factors of each pattern, for matrices
# that recur. Ours recur only in consecutive solves, and a factor of a large mesh takes a gigabyte.
def remember_factors(count: int) -> None:
    """Let the solver keep so many factors of each pattern, of CHOLMOD and of UMFPACK each."""
    sparsax.set_umf_cache_size(count)
    sparsax.set_num_cache_size(count)


remember_factors(2)


def quiet_blas() -> None:
    """Hold the BLAS inside the sparse solver to one thread.

    A second thread pool beside XLA's oversubscribes the cores: a factorisation of 2.5 ms then took
    up to 250 ms. Only the library bundled with sparsax is changed, not NumPy's.
    """
    for library in ThreadpoolController().lib_controllers:
        if "sparsax" in library.filepath:
            library.set_num_threads(1)


@dataclass(frozen=True)
class SuiteSparse:
    """One of SuiteSparse's factorisations."""

    name: str
    function: Callable[..., jax.Array]
    definite: bool
    on_host = False

    @property
    def triangle(self) -> bool:
        """CHOLMOD wants it, UMFPACK takes the whole matrix."""
        return self.definite

    def check(self) -> None:
        """Always there."""

    def solve(self, structure: Structure, values: jax.Array, rhs: jax.Array) -> jax.Array:
        """``x`` with ``A x = rhs``, shape of ``rhs``."""
        return self.function(structure.rows, structure.columns, values, rhs)


CHOLMOD = SuiteSparse("cholmod", sparsax.solve, definite=True)
UMFPACK = SuiteSparse("umfpack", sparsax.umf_solve, definite=False)
