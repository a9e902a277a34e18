"""Finite elements: the reference by which every other forward map is judged."""

from emulator.fem.campaign import Runs, run_campaign, solve_together
from emulator.fem.campaign.designs import design, sobol, uniform
from emulator.fem.newton import NewtonOptions
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
