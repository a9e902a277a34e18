"""Names of the built-in scenes, and making a scene from a name, a recipe or a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from emulator.errors import InputError
from emulator.scenes.beams import once_clamped_beam, twice_clamped_beam
from emulator.scenes.biventricle import biventricle
from emulator.scenes.file import read_scene
from emulator.scenes.left_ventricle import left_ventricle
from emulator.scenes.left_ventricle_neo_hookean import left_ventricle_neo_hookean
from emulator.scenes.left_ventricle_segments import left_ventricle_segments
from emulator.scenes.liver import liver
from emulator.scenes.published import published_scene
from emulator.scenes.scene import Scene
from emulator.scenes.traction_beams import traction_beam_guccione, traction_beam_holzapfel_ogden
from emulator.scenes.twisting_cube import twisting_cube

BUILT_IN: dict[str, Callable[..., Scene]] = {
    scene.__name__: scene
    for scene in (
        once_clamped_beam,
        twice_clamped_beam,
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


def find_scene(name: str, root: str | Path | None = None) -> Scene:
    """The scene called ``name``.

    Parameters
    ----------
    name : a built-in scene, a ``.toml`` file, or ``published:<Model>``.
    root : folder of the published data, for the last of these.

    Raises
    ------
    InputError
        No such scene or file.
    """
    if name.startswith("published:"):
        if root is None:
            raise InputError(f"scene '{name}': say where the published data is with --root DIR")
        return published_scene(name.removeprefix("published:"), root)
    if name.endswith(".toml"):
        return read_scene(name)
    if name not in BUILT_IN:
        raise InputError(
            f"scene '{name}' is unknown; built in: {', '.join(sorted(BUILT_IN))}; "
            "or give a .toml file, or published:<Model> with --root DIR"
        )
    return BUILT_IN[name]()


def scene_from_recipe(recipe: Mapping[str, Any]) -> Scene:
    """The scene a recipe was written from; recipes are plain JSON."""
    options = dict(recipe)
    name = options.pop("scene", None)
    if name == "file":
        return read_scene(options["path"])
    if isinstance(name, str) and name.startswith("published:"):
        return find_scene(name, options["root"])
    if name not in BUILT_IN:
        raise InputError(f"recipe names scene '{name}'; built in: {', '.join(sorted(BUILT_IN))}")
    # JSON has lists where the generators take tuples.
    return BUILT_IN[name](
        **{key: tuple(v) if isinstance(v, list) else v for key, v in options.items()}
    )
