"""Scenes: what can be simulated, emulated and calibrated."""

from emulator.scenes.beams import once_clamped_beam, twice_clamped_beam
from emulator.scenes.parameters import Parameter
from emulator.scenes.registry import BUILT_IN, find_scene, scene_from_recipe
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support
from emulator.scenes.twisting_cube import twisting_cube

__all__ = [
    "BUILT_IN",
    "Parameter",
    "Scene",
    "Support",
    "find_scene",
    "once_clamped_beam",
    "scene_from_recipe",
    "twice_clamped_beam",
    "twisting_cube",
]
