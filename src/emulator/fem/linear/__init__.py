"""Linear solves with a tangent: its sparsity pattern, SuiteSparse's factors, and outcomes."""

from emulator.fem.linear.pattern import Pattern, block_pattern, upper_blocks, whole_blocks
from emulator.fem.linear.suitesparse import Outcome

__all__ = ["Outcome", "Pattern", "block_pattern", "upper_blocks", "whole_blocks"]
