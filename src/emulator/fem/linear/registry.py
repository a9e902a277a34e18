"""The direct solvers by name."""

from __future__ import annotations

from emulator.core.errors import look_up
from emulator.fem.linear.petsc import PETSC
from emulator.fem.linear.protocol import Direct
from emulator.fem.linear.suitesparse import SUITESPARSE

SOLVERS: dict[str, Direct] = {kind.name: kind for kind in (SUITESPARSE, PETSC)}


def find_solver(name: str) -> Direct:
    """The solver of that name; :class:`InputError` if unknown, or its library is missing."""
    solver = look_up(SOLVERS, name, "factorisation")
    solver.check()
    return solver
