"""Scenes: what can be simulated, emulated and calibrated."""

from emulator.scenes import loads as loads
from emulator.scenes import supports as supports
from emulator.scenes.built_in import (
    BUILT_IN,
    biventricle,
    left_ventricle,
    left_ventricle_neo_hookean,
    left_ventricle_segments,
    liver,
    once_clamped_beam,
    traction_beam_guccione,
    traction_beam_holzapfel_ogden,
    turned_beam,
    twice_clamped_beam,
    twisting_cube,
)
from emulator.scenes.fibre_rules import Helix
from emulator.scenes.parameter_space import Parameter as Parameter
from emulator.scenes.scene import Scene as Scene
from emulator.scenes.supports import Support as Support
from emulator.scenes.tissue import FibreAngles

__all__ = [
    "BUILT_IN",
    "FibreAngles",
    "Helix",
    "biventricle",
    "left_ventricle",
    "left_ventricle_neo_hookean",
    "left_ventricle_segments",
    "liver",
    "once_clamped_beam",
    "traction_beam_guccione",
    "traction_beam_holzapfel_ogden",
    "turned_beam",
    "twice_clamped_beam",
    "twisting_cube",
]
