"""Linear solves with a tangent: its sparsity pattern, direct solvers by name, and their outcomes.

A linear solver is a file with a class that satisfies :class:`Direct`, and an entry of
:data:`SOLVERS`.
"""

from emulator.core.errors import look_up
from emulator.fem.linear.pattern import Pattern, block_pattern, upper_blocks, whole_blocks
from emulator.fem.linear.petsc import PETSC
from emulator.fem.linear.solve import Direct, Outcome
from emulator.fem.linear.suitesparse import SUITESPARSE

__all__ = [
    "SOLVERS",
    "Direct",
    "Outcome",
    "Pattern",
    "block_pattern",
    "find_solver",
    "upper_blocks",
    "whole_blocks",
]

SOLVERS: dict[str, Direct] = {solver.name: solver for solver in (SUITESPARSE, PETSC)}
"""The direct solvers by name."""


def find_solver(name: str) -> Direct:
    """Return the solver of that name; :class:`InputError` if its library is missing."""
    solver = look_up(SOLVERS, name, "factorisation")
    solver.check()
    return solver
