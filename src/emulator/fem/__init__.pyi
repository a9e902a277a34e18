from .campaign import Runs, run_campaign
from .campaign.designs import design, sobol, uniform
from .campaign.store import read_runs
from .energy import potential_energy, strain_energy
from .fields import displacement_gradient, element_fields
from .newton import NewtonOptions
from .simulator import Simulator
from .solution import Solution, Status
from .unloading import Unloaded, Unloader, unload

__all__ = [
    "NewtonOptions",
    "Runs",
    "Simulator",
    "Solution",
    "Status",
    "Unloaded",
    "Unloader",
    "design",
    "displacement_gradient",
    "element_fields",
    "potential_energy",
    "read_runs",
    "run_campaign",
    "sobol",
    "strain_energy",
    "uniform",
    "unload",
]
