"""Scenes: what can be simulated, emulated and calibrated."""

from emulator.scenes import loads, supports
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
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

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
