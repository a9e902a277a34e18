from . import fem, scenes
from .catalogue import find_scene
from .error.mesh_error import MeshError, mesh_error
from .errors import InputError, SolverError
from .fem import NewtonOptions, Simulator, Solution, Status
from .fem.functional import potential_energy
from .geometry.io import Body, read_body, read_mesh
from .geometry.mesh import Mesh
from .scenes import Parameter, Scene, Support
from .surrogates import Emulator, load, save_emulator, shipped
from .surrogates.fem import FEMForward, fem_forward
from .surrogates.protocol import ForwardMap, Prediction
from .surrogates.released_network import released_network

__version__: str

__all__ = [
    "Body",
    "Emulator",
    "FEMForward",
    "ForwardMap",
    "InputError",
    "Mesh",
    "MeshError",
    "NewtonOptions",
    "Parameter",
    "Prediction",
    "Scene",
    "Simulator",
    "Solution",
    "SolverError",
    "Status",
    "Support",
    "fem",
    "fem_forward",
    "find_scene",
    "load",
    "mesh_error",
    "potential_energy",
    "read_body",
    "read_mesh",
    "released_network",
    "save_emulator",
    "scenes",
    "shipped",
]
