"""Emulators and simulators of soft-tissue mechanics.

A scene gives one potential energy. :class:`Simulator` minimises it by finite elements;
:func:`load` gives an emulator trained on it, whose ``.cache()`` is a fast differentiable map.

Importing this package turns on JAX's float64 mode, the project's only global setting.
"""

from emulator import _precision  # noqa: F401, I001 - must come first
from emulator import scenes
from emulator.errors import InputError, SolverError
from emulator.fem import NewtonOptions, Simulator, Solution, Status
from emulator.surrogates.fem import FEMForward, fem_forward
from emulator.surrogates.protocol import ForwardMap, Prediction
from emulator.fem.functional import potential_energy
from emulator.surrogates import Emulator, load, save_emulator, shipped
from emulator.catalogue import find_scene
from emulator.scenes import Parameter, Scene, Support

__version__ = "0.1.0"

__all__ = [
    "Emulator",
    "FEMForward",
    "ForwardMap",
    "InputError",
    "NewtonOptions",
    "Parameter",
    "Prediction",
    "Scene",
    "Simulator",
    "Solution",
    "SolverError",
    "Status",
    "Support",
    "fem_forward",
    "find_scene",
    "load",
    "potential_energy",
    "save_emulator",
    "scenes",
    "shipped",
]
