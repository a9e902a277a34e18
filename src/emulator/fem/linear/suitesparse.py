"""SuiteSparse through sparsax, inside compiled programs.

CHOLMOD for positive definite matrices, UMFPACK for any. A refusal is an outcome, not an exception
(:mod:`emulator.fem.linear.foreign`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sparsax
import sparsax_cpp
from threadpoolctl import ThreadpoolController

from emulator.fem.linear.foreign import register
from emulator.fem.linear.protocol import Outcome, Structure

_CHOLMOD, _UMFPACK = "calibrate_cholmod", "calibrate_umfpack"
_KEPT = 2  # factors of a pattern
_room = [_KEPT]  # the last is in force; the cache is the library's, and the process has one


def _outcome(message: str) -> int | None:
    if "not positive definite" in message:
        return int(Outcome.INDEFINITE)
    return int(Outcome.SINGULAR) if "singular" in message else None


@cache
def _made_ready() -> None:
    """Once a process.

    The BLAS inside the sparse solver is held to one thread: a second pool beside XLA's
    oversubscribes the cores, and a factorisation of 2.5 ms then took up to 250 ms. Only the library
    bundled with sparsax is changed, not NumPy's.

    By default sparsax caches up to 32 UMFPACK and 8 CHOLMOD factors of each pattern, for matrices
    that recur. Ours recur only in consecutive solves, and a factor of a large mesh takes a
    gigabyte.
    """
    register(_CHOLMOD, sparsax_cpp.solve_f64_capsule(), _outcome)
    register(_UMFPACK, sparsax_cpp.umf_solve_f64_capsule(), _outcome)
    for library in ThreadpoolController().lib_controllers:
        if "sparsax" in library.filepath:
            library.set_num_threads(1)
    sparsax.set_umf_cache_size(_KEPT)
    sparsax.set_num_cache_size(_room[-1])


@contextmanager
def keep_factors(count: int) -> Iterator[None]:
    """Inside, keep ``count`` Cholesky factors of a pattern.

    As many as there are threads that solve; one where two would not fit into memory: a
    factorisation then takes the room of the one before. Without, two are kept.
    """
    _made_ready()
    _room.append(count)
    sparsax.set_num_cache_size(count)
    try:
        yield
    finally:
        _room.remove(count)
        sparsax.set_num_cache_size(_room[-1])


def forget_factors() -> None:
    """Free all factors and all orderings of patterns, which take as long as a factorisation."""
    sparsax.clear_cache()


@dataclass(frozen=True)
class SuiteSparse:
    """CHOLMOD and UMFPACK."""

    name = "suitesparse"
    on_host = False

    def check(self) -> None:
        """Always there."""
        _made_ready()

    def solve(
        self,
        structure: Structure,
        values: jax.Array,
        rhs: jax.Array,
        *,
        definite: bool,
        transposed: bool = False,
    ) -> tuple[jax.Array, jax.Array]:
        """By CHOLMOD, or by UMFPACK, which takes both triangles."""
        if definite:
            matrix = structure.rows, structure.columns, values
            return _call(_CHOLMOD, matrix, rhs, mode=np.int64(0))
        return _call(_UMFPACK, structure.both(values), rhs, trans=np.int64(transposed))


SUITESPARSE = SuiteSparse()


def _call(
    target: str, matrix: tuple[np.ndarray, np.ndarray, jax.Array], rhs: jax.Array, **flags: Any
) -> tuple[jax.Array, jax.Array]:
    _made_ready()
    shapes = jax.ShapeDtypeStruct(rhs.shape, jnp.float64), jax.ShapeDtypeStruct((), jnp.int32)
    call = jax.ffi.ffi_call(target, shapes, vmap_method="sequential")
    x, outcome = call(*matrix, rhs, **flags)
    return x, outcome
