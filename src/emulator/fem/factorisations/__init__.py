"""Factorisations of sparse matrices by name, and which of them a simulator uses."""

from emulator.fem.factorisations.protocol import REFUSALS, Factorisation, Structure
from emulator.fem.factorisations.registry import (
    CHOICES,
    FACTORISATIONS,
    Choice,
    find_choice,
    find_factorisation,
)

__all__ = [
    "CHOICES",
    "FACTORISATIONS",
    "REFUSALS",
    "Choice",
    "Factorisation",
    "Structure",
    "find_choice",
    "find_factorisation",
]
