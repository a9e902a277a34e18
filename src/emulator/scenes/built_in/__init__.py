"""The built-in scenes; ``BUILT_IN`` is their registry."""

from collections.abc import Callable

from emulator.scenes.built_in.boxes import (
    once_clamped_beam,
    traction_beam_guccione,
    traction_beam_holzapfel_ogden,
    turned_beam,
    twice_clamped_beam,
    twisting_cube,
)
from emulator.scenes.built_in.liver import liver
from emulator.scenes.built_in.ventricles import (
    biventricle,
    left_ventricle,
    left_ventricle_neo_hookean,
    left_ventricle_segments,
)
from emulator.scenes.scene import Scene

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
