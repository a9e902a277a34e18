from . import fem, geometry, hearts, released, scenes, specimens
from .accuracy.comparison import evaluate
from .accuracy.estimate import ErrorBar
from .accuracy.mesh_error import MeshError, mesh_error
from .catalogue import find_scene
from .core.errors import InputError, SolverError
from .fem import Simulator
from .fem.campaign.designs import fem_reference
from .geometry import generators
from .geometry.io import read_body, read_mesh, write_mesh, write_solution
from .geometry.mesh import Mesh
from .geometry.side_by_side import side_by_side
from .mechanics import laws
from .mechanics.laws import find_law
from .scenes import Parameter, Scene, Support, loads, supports
from .scenes.draft import draft_scene
from .scenes.finer import finer
from .specimens.homogeneous import homogeneous
from .specimens.specimen import specimen
from .surrogates import Emulator, load, save_emulator, shipped
from .surrogates.corrected import corrected, newton_step
from .surrogates.fem import FEMForward, fem_forward
from .surrogates.pod_gp import fit_reduced
from .surrogates.protocol import ForwardMap, Prediction
from .surrogates.released_network import released_network
from .surrogates.taylor import expand
from .training import Plan, families, recipe, train

__version__: str

__all__ = [
    "Emulator",
    "ErrorBar",
    "FEMForward",
    "ForwardMap",
    "InputError",
    "Mesh",
    "MeshError",
    "Parameter",
    "Plan",
    "Prediction",
    "Scene",
    "Simulator",
    "SolverError",
    "Support",
    "corrected",
    "draft_scene",
    "evaluate",
    "expand",
    "families",
    "fem",
    "fem_forward",
    "fem_reference",
    "find_law",
    "find_scene",
    "finer",
    "fit_reduced",
    "generators",
    "geometry",
    "hearts",
    "homogeneous",
    "laws",
    "load",
    "loads",
    "mesh_error",
    "newton_step",
    "read_body",
    "read_mesh",
    "recipe",
    "released",
    "released_network",
    "save_emulator",
    "scenes",
    "shipped",
    "side_by_side",
    "specimen",
    "specimens",
    "supports",
    "train",
    "write_mesh",
    "write_solution",
]
