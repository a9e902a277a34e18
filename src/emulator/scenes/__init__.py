"""Scenes: what can be simulated, emulated and calibrated."""

from emulator.scenes import loads, supports
from emulator.scenes.beams import once_clamped_beam, turned_beam, twice_clamped_beam
from emulator.scenes.biventricle import biventricle
from emulator.scenes.left_ventricle import left_ventricle
from emulator.scenes.left_ventricle_neo_hookean import left_ventricle_neo_hookean
from emulator.scenes.left_ventricle_segments import left_ventricle_segments
from emulator.scenes.liver import liver
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.registry import BUILT_IN
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support
from emulator.scenes.traction_beams import traction_beam_guccione, traction_beam_holzapfel_ogden
from emulator.scenes.twisting_cube import twisting_cube

__all__ = [
    "BUILT_IN",
    "Parameter",
    "Scene",
    "Support",
    "biventricle",
    "left_ventricle",
    "left_ventricle_neo_hookean",
    "left_ventricle_segments",
    "liver",
    "loads",
    "once_clamped_beam",
    "supports",
    "traction_beam_guccione",
    "traction_beam_holzapfel_ogden",
    "turned_beam",
    "twice_clamped_beam",
    "twisting_cube",
]
