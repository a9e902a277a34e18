from .campaign import Runs, run_campaign, solve_together
from .campaign.designs import design, sobol, uniform
from .campaign.store import read_runs
from .energy import displacement_gradient, point_energy, potential_energy, strain_energy
from .fields import element_fields
from .newton import NewtonOptions
from .reactions import SupportForce
from .simulator import Simulator
from .solution import Solution, Status
from .unloading import Unloaded, Unloader, unload

__all__ = [
    "NewtonOptions",
    "Runs",
    "Simulator",
    "Solution",
    "Status",
    "SupportForce",
    "Unloaded",
    "Unloader",
    "design",
    "displacement_gradient",
    "element_fields",
    "point_energy",
    "potential_energy",
    "read_runs",
    "run_campaign",
    "sobol",
    "solve_together",
    "strain_energy",
    "uniform",
    "unload",
]
