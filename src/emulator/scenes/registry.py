"""The built-in scenes, by name."""

from __future__ import annotations

from collections.abc import Callable

from emulator.scenes.beams import once_clamped_beam, turned_beam, twice_clamped_beam
from emulator.scenes.biventricle import biventricle
from emulator.scenes.left_ventricle import left_ventricle
from emulator.scenes.left_ventricle_neo_hookean import left_ventricle_neo_hookean
from emulator.scenes.left_ventricle_segments import left_ventricle_segments
from emulator.scenes.liver import liver
from emulator.scenes.scene import Scene
from emulator.scenes.traction_beams import traction_beam_guccione, traction_beam_holzapfel_ogden
from emulator.scenes.twisting_cube import twisting_cube

BUILT_IN: dict[str, Callable[..., Scene]] = {
    scene.__name__: scene
    for scene in (
        once_clamped_beam,
        twice_clamped_beam,
        turned_beam,
        traction_beam_holzapfel_ogden,
        traction_beam_guccione,
        twisting_cube,
        liver,
        left_ventricle,
        left_ventricle_neo_hookean,
        left_ventricle_segments,
        biventricle,
    )
}
