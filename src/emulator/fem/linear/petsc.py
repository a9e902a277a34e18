r"""PETSc with MUMPS, an optional extra for meshes that SuiteSparse cannot hold.

A symmetric matrix is factorised as :math:`L D L^T`, whose number of negative pivots is the number
of negative eigenvalues (Sylvester's law of inertia); any other as :math:`L U`. PETSc's options come
from its environment variable, e.g. ``PETSC_OPTIONS="-mat_mumps_icntl_22 1"`` for factors on disk.
Each process works alone: matrices are assembled on one, so PETSc is not given several.

Python calls PETSc where the numbers are known. Inside ``jax.jit`` a callback leads to it, which
copies the matrix and keeps the program out of JAX's cache on disk.
"""

from __future__ import annotations

import importlib
import threading
from contextlib import suppress
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.fem.linear.pattern import Pattern
from emulator.fem.linear.solve import Direct, Kind, Outcome, Solved

INSTALL = "pip install dolfinx-solver-real mpich mpi4py, or petsc4py for a PETSc with MUMPS"
# Residual relative to |A| |x| + |b| that a direct solver leaves at most. Block low-rank factors
# without iterations leave more.
_BACKWARD_ERROR = 1e-11
_WORKSPACE_TOO_SMALL = (-8, -9, -11, -14, -15, -17, -20)  # of INFOG(1), raised by ICNTL(14)


class SingularMatrix(ValueError):
    """The matrix has no factor."""


@cache
def petsc_module() -> Any:
    """Return the module ``petsc4py.PETSc``; :class:`InputError` where it cannot serve."""
    with suppress(ModuleNotFoundError):
        importlib.import_module("mpi4py.MPI")  # some wheels find their MPI only this way
    try:
        # PETSc's signal handler would end the process without Python's clean-up.
        importlib.import_module("petsc4py").init(["petsc", "-no_signal_handler"])
        PETSc = importlib.import_module("petsc4py.PETSc")
    except ModuleNotFoundError:
        raise InputError(f"factorisation 'petsc': petsc4py is not installed; {INSTALL}") from None
    except ImportError as error:
        raise InputError(f"factorisation 'petsc': petsc4py does not load: {error}") from None
    if PETSc.ScalarType is not np.float64:
        kind = np.dtype(PETSc.ScalarType).name
        raise InputError(f"factorisation 'petsc': this PETSc has {kind} numbers; float64 needed")
    if not PETSc.Sys.hasExternalPackage("mumps"):
        raise InputError(f"factorisation 'petsc': this PETSc is without MUMPS; {INSTALL}")
    return PETSc


class Factor:
    """The factor of the last matrix of one pattern; the pattern is analysed once for all."""

    def __init__(self, pattern: Pattern) -> None:
        PETSc = petsc_module()
        self._pattern = pattern
        starts = np.searchsorted(pattern.rows, np.arange(pattern.size + 1))
        self._csr = starts.astype(PETSc.IntType), pattern.columns.astype(PETSc.IntType)
        self._values = np.full(len(pattern.rows), np.nan)
        csr = (*self._csr, np.zeros(len(pattern.rows)))
        shape, alone = (pattern.size, pattern.size), PETSc.COMM_SELF
        matrix = PETSc.Mat()
        if pattern.upper:
            self._matrix = matrix.createSBAIJ(shape, 1, csr=csr, comm=alone)
        else:
            self._matrix = matrix.createAIJ(shape, csr=csr, comm=alone)
        self._ksp = PETSc.KSP().create(alone)
        self._ksp.setType("preonly")
        kind = "cholesky" if pattern.upper else "lu"
        pc = self._ksp.getPC()
        pc.setType(kind)
        pc.setFactorSolverType("mumps")
        self._ksp.setFromOptions()
        options = pc.getType(), pc.getFactorSolverType()
        if options != (kind, "mumps"):
            raise InputError(
                f"factorisation 'petsc': PETSC_OPTIONS ask for {' of '.join(map(str, options))}; "
                f"leave it at {kind} of mumps"
            )
        self._ksp.setOperators(self._matrix)
        self.factorisations = 0

    def serves(self, pattern: Pattern) -> bool:
        """Return whether matrices of ``pattern`` have this factor's structure."""
        own = self._pattern
        return pattern is own or (
            (pattern.size, pattern.upper) == (own.size, own.upper)
            and np.array_equal(pattern.rows, own.rows)
            and np.array_equal(pattern.columns, own.columns)
        )

    def factorise(self, values: np.ndarray) -> None:
        """Factorise the matrix of ``values`` (nnz,), unless it is the last one."""
        if np.array_equal(values, self._values):
            return
        self._values.fill(np.nan)  # if this fails, no matrix has a factor
        self._matrix.setValuesCSR(*self._csr, values)
        self._matrix.assemble()
        self._ksp.setOperators(self._matrix)
        self._ksp.setUp()
        self._check_factor()
        self._norm = self._matrix.norm(petsc_module().NormType.INFINITY)
        self._values[:] = values
        self.factorisations += 1

    def negative_eigenvalues(self) -> int:
        """Return the symmetric matrix's number of negative pivots, INFOG(12) of MUMPS."""
        return self._ksp.getPC().getFactorMatrix().getMumpsInfog(12)

    def solve(self, b: np.ndarray, *, transposed: bool = False) -> np.ndarray:
        """Return ``x`` (size,) with ``A x = b``, or with the transposed matrix."""
        PETSc = petsc_module()
        rhs = PETSc.Vec().createWithArray(np.ascontiguousarray(b), comm=PETSc.COMM_SELF)
        x, residual = rhs.duplicate(), rhs.duplicate()
        (self._ksp.solveTranspose if transposed else self._ksp.solve)(rhs, x)
        (self._matrix.multTranspose if transposed else self._matrix.mult)(x, residual)
        residual.aypx(-1.0, rhs)
        solution, left = x.getArray().copy(), np.abs(residual.getArray()).max()
        size = self._norm * np.abs(solution).max() + np.abs(b).max()
        reason = self._ksp.getConvergedReason()
        if reason < 0 or not left <= _BACKWARD_ERROR * size:
            raise InputError(
                f"petsc: the solution leaves a residual of {left / size:.0e} of |A||x| + |b| "
                f"(KSP: {reason}); with an approximate factor, iterate: add "
                "-ksp_type fgmres -ksp_rtol 1e-10 to PETSC_OPTIONS"
            )
        return solution

    def _check_factor(self) -> None:
        """Raise the reason where there is no factor; :class:`InputError` if options would help."""
        pc = self._ksp.getPC()
        reason, kinds = pc.getFailedReason(), petsc_module().PC.FailedReason
        if reason == kinds.NOERROR:
            return
        code, detail = (pc.getFactorMatrix().getMumpsInfog(k) for k in (1, 2))
        codes = f"INFOG(1) = {code}, INFOG(2) = {detail}"
        if reason in (kinds.FACTOR_NUMERIC_ZEROPIVOT, kinds.FACTOR_STRUCT_ZEROPIVOT):
            raise SingularMatrix(f"petsc: matrix is singular (MUMPS: {codes})")
        if code in _WORKSPACE_TOO_SMALL:
            raise InputError(
                f"petsc: MUMPS needs more working space than it estimated ({codes}); "
                "add -mat_mumps_icntl_14 100 to PETSC_OPTIONS"
            )
        raise ValueError(f"petsc: no factor (MUMPS: {codes})")


class Petsc(Direct):
    """LDL^T where the matrix is symmetric, LU where not; inertia tells whether it is definite.

    factor : the one factor that the process keeps, because a factor may take all of its memory.
    """

    name, on_host = "petsc", True

    def __init__(self) -> None:
        self.factor: Factor | None = None
        self._lock = threading.Lock()  # one thread solves at a time

    def check(self) -> None:
        """Raise :class:`InputError` where PETSc or MUMPS is missing."""
        petsc_module()

    def solve(self, pattern: Pattern, values: jax.Array, rhs: jax.Array, kind: Kind) -> Solved:
        """Solve by LDL^T, whose pivots must be positive where definite, or LU."""
        on_host = partial(self._solve, pattern, kind=kind)
        if not any(isinstance(x, jax.core.Tracer) for x in (values, rhs)):
            x, outcome = on_host(values, rhs)
            return jnp.asarray(x), jnp.asarray(outcome)
        shapes = jax.ShapeDtypeStruct(rhs.shape, rhs.dtype), jax.ShapeDtypeStruct((), jnp.int32)
        x, outcome = jax.pure_callback(on_host, shapes, values, rhs, vmap_method="sequential")
        return x, outcome

    def _solve(
        self, pattern: Pattern, values: jax.Array, b: jax.Array, kind: Kind
    ) -> tuple[np.ndarray, np.int32]:
        columns = np.asarray(b)
        with self._lock:
            try:
                factor = self._factorised(pattern, np.asarray(values))
            except SingularMatrix:
                return np.full(columns.shape, np.nan), np.int32(Outcome.SINGULAR)
            if kind == "definite" and factor.negative_eigenvalues():
                return np.full(columns.shape, np.nan), np.int32(Outcome.INDEFINITE)
            transposed = kind == "transposed" and not pattern.upper
            solve = partial(factor.solve, transposed=transposed)
            if columns.ndim == 1:
                return solve(columns), np.int32(Outcome.OK)
            return np.stack([solve(each) for each in columns.T], axis=1), np.int32(Outcome.OK)

    def _factorised(self, pattern: Pattern, values: np.ndarray) -> Factor:
        """Return the factor of a matrix; the one before is overwritten or freed."""
        if self.factor is None or not self.factor.serves(pattern):
            self.factor = None  # freed before the next one is allocated
            self.factor = Factor(pattern)
        try:
            self.factor.factorise(values)
        except Exception:
            self.factor = None  # MUMPS cannot go on from a failure
            raise
        return self.factor


PETSC = Petsc()
"""The process's one solver by PETSC, and with it the process's one factor."""
