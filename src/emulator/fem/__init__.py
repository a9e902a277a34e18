"""Finite elements: the reference every other forward map is judged by."""

from emulator.fem.campaign import Runs, run_campaign, solve_together
from emulator.fem.campaign.designs import design, sobol, uniform
from emulator.fem.options import NewtonOptions
from emulator.fem.simulator import Simulator
from emulator.fem.solution import Solution, Status

__all__ = [
    "NewtonOptions",
    "Runs",
    "Simulator",
    "Solution",
    "Status",
    "design",
    "run_campaign",
    "sobol",
    "solve_together",
    "uniform",
]
