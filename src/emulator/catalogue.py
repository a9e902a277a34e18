"""Scenes by name, file or origin: built in, TOML or released."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from emulator.core.errors import InputError
from emulator.scenes.built_in import BUILT_IN
from emulator.scenes.file import read_scene
from emulator.scenes.finer import FINER, Finer, finer
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, with_mesh

_RELEASED = "published:"


def find_scene(name: str, root: str | Path | None = None) -> Scene:
    """Return the scene called ``name``, as :func:`find_problem`; a specimen is refused."""
    return with_mesh(find_problem(name, root))


def find_problem(name: str, root: str | Path | None = None) -> ForwardProblem:
    """Return the scene or the specimen called ``name``.

    Parameters
    ----------
    name : a built-in scene, a ``.toml`` file, or ``published:<Model>``; ``finer:`` before any of
        them is that scene on the next finer mesh of its body.
    root : folder of the published data, for a published model.

    Raises
    ------
    InputError
        No such scene or file.
    """
    word, _, of = name.partition(":")
    if of and word == FINER:
        return finer(find_scene(of, root)).scene
    if name.startswith(_RELEASED):
        if root is None:
            raise InputError(f"scene '{name}': say where the published data is with --root DIR")
        from emulator.released.scenes import published_scene  # a room

        return published_scene(name.removeprefix(_RELEASED), root)
    if name.endswith(".toml"):
        return read_scene(name)
    if name not in BUILT_IN:
        raise InputError(
            f"scene '{name}' is unknown; built in: {', '.join(sorted(BUILT_IN))}; "
            "or give a .toml file, or published:<Model> with --root DIR; finer:SCENE refines"
        )
    return BUILT_IN[name]()


def scene_from_origin(origin: Mapping[str, Any]) -> Scene:
    """Return the scene that ``origin``, plain JSON, describes; ``Scene.origin`` is one."""
    options = dict(origin)
    name = options.pop("scene", None)
    if name == FINER:
        return finer(scene_from_origin(options["of"])).scene
    if name == "file":
        return with_mesh(read_scene(options["path"]))
    if isinstance(name, str) and name.startswith(_RELEASED):
        return find_scene(name, options["root"])
    if name not in BUILT_IN:
        raise InputError(f"origin names scene '{name}'; built in: {', '.join(sorted(BUILT_IN))}")
    # JSON has lists where the generators take tuples.
    return BUILT_IN[name](
        **{key: tuple(v) if isinstance(v, list) else v for key, v in options.items()}
    )


def finer_of(scene: Scene) -> Finer:
    """Return the refinement that made ``scene``, with the scene on the coarser mesh.

    Raises
    ------
    InputError
        ``scene`` was not made by :func:`~emulator.scenes.finer.finer`.
    """
    if scene.origin.get("scene") != FINER:
        raise InputError(
            f"scene '{scene.name}' is not on a mesh made finer; name it finer:{scene.name}"
        )
    return finer(scene_from_origin(scene.origin["of"]))
