from . import fem, scenes
from .accuracy.comparison import evaluate
from .accuracy.mesh_error import MeshError, mesh_error
from .catalogue import find_scene
from .core.errors import InputError, SolverError
from .fem import NewtonOptions, Simulator, Solution, Status, run_campaign
from .fem.campaign.designs import fem_reference
from .fem.campaign.store import read_runs
from .fem.energy import displacement_gradient, potential_energy, strain_energy
from .fem.fields import element_fields
from .fem.unloading import Unloaded, Unloader, unload
from .geometry import generators
from .geometry.facets import Cavity
from .geometry.fibres import wall_depth
from .geometry.io import Body, read_body, read_mesh, write_mesh, write_solution
from .geometry.mesh import Mesh, boundary_facets
from .geometry.random_field import matern_modes
from .geometry.side_by_side import Bodies, side_by_side
from .hearts.heart import mesh_wall
from .hearts.sheet import mesh_sheet, regions_within
from .mechanics import laws
from .mechanics.laws import find_law
from .scenes import Parameter, Scene, Support, loads, supports
from .scenes.draft import draft_scene
from .scenes.finer import finer
from .specimens.homogeneous import homogeneous
from .specimens.specimen import specimen
from .specimens.tube import Tube
from .surrogates import Emulator, load, save_emulator, shipped
from .surrogates.corrected import corrected
from .surrogates.fem import FEMForward, fem_forward
from .surrogates.pod_gp import fit_reduced
from .surrogates.protocol import ForwardMap, Prediction
from .surrogates.released_network import released_network
from .training import Plan, recipe, train

__version__: str

__all__ = [
    "Bodies",
    "Body",
    "Cavity",
    "Emulator",
    "FEMForward",
    "ForwardMap",
    "InputError",
    "Mesh",
    "MeshError",
    "NewtonOptions",
    "Parameter",
    "Plan",
    "Prediction",
    "Scene",
    "Simulator",
    "Solution",
    "SolverError",
    "Status",
    "Support",
    "Tube",
    "Unloaded",
    "Unloader",
    "boundary_facets",
    "corrected",
    "displacement_gradient",
    "draft_scene",
    "element_fields",
    "evaluate",
    "fem",
    "fem_forward",
    "fem_reference",
    "find_law",
    "find_scene",
    "finer",
    "fit_reduced",
    "generators",
    "homogeneous",
    "laws",
    "load",
    "loads",
    "matern_modes",
    "mesh_error",
    "mesh_sheet",
    "mesh_wall",
    "potential_energy",
    "read_body",
    "read_mesh",
    "read_runs",
    "recipe",
    "regions_within",
    "released_network",
    "run_campaign",
    "save_emulator",
    "scenes",
    "shipped",
    "side_by_side",
    "specimen",
    "strain_energy",
    "supports",
    "train",
    "unload",
    "wall_depth",
    "write_mesh",
    "write_solution",
]
