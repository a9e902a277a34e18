r"""Factors of sparse matrices by MUMPS, through PETSc's Python package.

A symmetric matrix is factorised as :math:`L D L^T`, whose number of negative pivots is that of the
negative eigenvalues (Sylvester's law of inertia); any other as :math:`L U`. PETSc's options come
from its environment variable, e.g. ``PETSC_OPTIONS="-mat_mumps_icntl_22 1"`` for factors on disk.
Each process works alone: matrices are assembled on one, so PETSc is not given several.
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np

from emulator.core.errors import InputError
from emulator.fem.linear.protocol import Structure

INSTALL = "pip install dolfinx-solver-real mpich mpi4py, or petsc4py for a PETSc with MUMPS"
# Residual relative to |A| |x| + |b| that a direct solver leaves at most. Block low-rank factors
# without iterations leave more.
_BACKWARD_ERROR = 1e-11
_WORKSPACE_TOO_SMALL = (-8, -9, -11, -14, -15, -17, -20)  # of INFOG(1), raised by ICNTL(14)


class SingularMatrix(ValueError):
    """The matrix has no factor."""


@cache
def petsc() -> Any:
    """The module ``petsc4py.PETSc``; :class:`InputError` where it cannot serve."""
    with suppress(ModuleNotFoundError):
        importlib.import_module("mpi4py.MPI")  # some wheels find their MPI only this way
    try:
        # PETSc's handler of signals would end the process its own way.
        importlib.import_module("petsc4py").init(["petsc", "-no_signal_handler"])
        PETSc = importlib.import_module("petsc4py.PETSc")
    except ModuleNotFoundError:
        raise InputError(f"factorisation 'petsc': petsc4py is not installed; {INSTALL}") from None
    except ImportError as error:
        raise InputError(f"factorisation 'petsc': petsc4py does not load: {error}") from None
    if PETSc.ScalarType is not np.float64:
        found = np.dtype(PETSc.ScalarType).name
        raise InputError(f"factorisation 'petsc': this PETSc has {found} numbers; float64 needed")
    if not PETSc.Sys.hasExternalPackage("mumps"):
        raise InputError(f"factorisation 'petsc': this PETSc is without MUMPS; {INSTALL}")
    return PETSc


class Factor:
    """Matrices of one structure and the factor of the last one; its analysis serves them all."""

    def __init__(self, structure: Structure) -> None:
        PETSc = petsc()
        self._structure = structure
        starts = np.searchsorted(structure.rows, np.arange(structure.size + 1))
        self._csr = starts.astype(PETSc.IntType), structure.columns.astype(PETSc.IntType)
        self._values = np.full(len(structure.rows), np.nan)
        csr = (*self._csr, np.zeros(len(structure.rows)))
        shape, alone = (structure.size, structure.size), PETSc.COMM_SELF
        self._matrix = (
            PETSc.Mat().createSBAIJ(shape, 1, csr=csr, comm=alone)
            if structure.upper
            else PETSc.Mat().createAIJ(shape, csr=csr, comm=alone)
        )
        self._ksp = PETSc.KSP().create(alone)
        self._ksp.setType("preonly")
        kind = "cholesky" if structure.upper else "lu"
        self._ksp.getPC().setType(kind)
        self._ksp.getPC().setFactorSolverType("mumps")
        self._ksp.setFromOptions()
        asked = self._ksp.getPC().getType(), self._ksp.getPC().getFactorSolverType()
        if asked != (kind, "mumps"):
            raise InputError(
                f"factorisation 'petsc': PETSC_OPTIONS ask for {' of '.join(map(str, asked))}; "
                f"leave it at {kind} of mumps"
            )
        self._ksp.setOperators(self._matrix)
        self.factorisations = 0

    def serves(self, structure: Structure) -> bool:
        """Whether matrices of ``structure`` can be given."""
        own = self._structure
        return structure is own or (
            (structure.size, structure.upper) == (own.size, own.upper)
            and np.array_equal(structure.rows, own.rows)
            and np.array_equal(structure.columns, own.columns)
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
        self._norm = self._matrix.norm(petsc().NormType.INFINITY)
        self._values[:] = values
        self.factorisations += 1

    def negative_eigenvalues(self) -> int:
        """How many the symmetric matrix has: negative pivots, INFOG(12) of MUMPS."""
        return self._ksp.getPC().getFactorMatrix().getMumpsInfog(12)

    def solve(self, b: np.ndarray, *, transposed: bool = False) -> np.ndarray:
        """``x`` (size,) with ``A x = b``, or the transposed matrix."""
        PETSc = petsc()
        rhs = PETSc.Vec().createWithArray(np.ascontiguousarray(b), comm=PETSc.COMM_SELF)
        x, residual = rhs.duplicate(), rhs.duplicate()
        (self._ksp.solveTranspose if transposed else self._ksp.solve)(rhs, x)
        (self._matrix.multTranspose if transposed else self._matrix.mult)(x, residual)
        residual.aypx(-1.0, rhs)
        found = x.getArray().copy()
        size = self._norm * np.abs(found).max() + np.abs(b).max()
        self._check_solution(np.abs(residual.getArray()).max(), size)
        return found

    def _check_factor(self) -> None:
        """Raise the reason where there is no factor; :class:`InputError` if options would help."""
        pc = self._ksp.getPC()
        failed, kinds = pc.getFailedReason(), petsc().PC.FailedReason
        if failed == kinds.NOERROR:
            return
        code, detail = (pc.getFactorMatrix().getMumpsInfog(k) for k in (1, 2))
        said = f"INFOG(1) = {code}, INFOG(2) = {detail}"
        if failed in (kinds.FACTOR_NUMERIC_ZEROPIVOT, kinds.FACTOR_STRUCT_ZEROPIVOT):
            raise SingularMatrix(f"petsc: matrix is singular (MUMPS: {said})")
        if code in _WORKSPACE_TOO_SMALL:
            raise InputError(
                f"petsc: MUMPS needs more working space than it estimated ({said}); "
                "add -mat_mumps_icntl_14 100 to PETSC_OPTIONS"
            )
        raise ValueError(f"petsc: no factor (MUMPS: {said})")

    def _check_solution(self, residual: float, size: float) -> None:
        reason = self._ksp.getConvergedReason()
        if reason < 0 or not residual <= _BACKWARD_ERROR * size:
            raise InputError(
                f"petsc: the solution leaves a residual of {residual / size:.0e} of |A||x| + |b| "
                f"(KSP: {reason}); with an approximate factor, iterate: add "
                "-ksp_type fgmres -ksp_rtol 1e-10 to PETSC_OPTIONS"
            )
