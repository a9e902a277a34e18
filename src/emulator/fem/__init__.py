"""Finite elements: the reference every other forward map is judged by."""

from emulator.fem.options import NewtonOptions
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Solution, Status

__all__ = ["NewtonOptions", "Simulator", "Solution", "Status"]
