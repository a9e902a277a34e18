"""Linear solves: the pattern of a tangent, direct solvers by name, and how a solve ended."""

from emulator.fem.linear.pattern import Pattern, block_pattern, upper_blocks, whole_blocks
from emulator.fem.linear.protocol import Direct, Outcome, Structure
from emulator.fem.linear.registry import SOLVERS, find_solver

__all__ = [
    "SOLVERS",
    "Direct",
    "Outcome",
    "Pattern",
    "Structure",
    "block_pattern",
    "find_solver",
    "upper_blocks",
    "whole_blocks",
]
