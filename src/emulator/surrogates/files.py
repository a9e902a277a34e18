"""Emulators on disk: ``emulator.json`` describes, ``weights.safetensors`` holds the arrays."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from emulator.catalogue import scene_from_origin
from emulator.core.errors import InputError
from emulator.core.store import inside, read_arrays, read_json, save_arrays, write_json
from emulator.scenes.scene import Scene
from emulator.surrogates.additive import PARTS, Emulator
from emulator.surrogates.kind import ForwardKind, Ingredients, Options
from emulator.surrogates.protocol import ForwardMap

FORMAT = 3
SHIPPED = Path(__file__).parent.parent / "shipped"


def save_emulator(emulator: Emulator, folder: str | Path) -> None:
    """Write ``emulator`` into ``folder``.

    The array ``derivatives`` of the part ``taylor`` is called ``taylor/derivatives``, and so on.
    """
    folder = Path(folder)
    if not emulator.parts:
        raise InputError("an emulator without any part has nothing to save")
    arrays = {
        f"{name}/{key}": _narrow(array)
        for name, part in emulator.parts.items()
        for key, array in part.arrays().items()
    }
    digest = save_arrays(folder / "weights.safetensors", arrays)
    write_json(
        folder / "emulator.json",
        {
            "format": FORMAT,
            "scene": dict(emulator.scene.origin),
            "fingerprint": emulator.scene.fingerprint,
            "parts": {name: part.to_json() for name, part in emulator.parts.items()},
            "weights_sha256": digest,
            "record": dict(emulator.record),
        },
    )


def _narrow(array: Any) -> np.ndarray:
    """The array in float32 where that loses nothing, which halves the file."""
    wide = np.asarray(array)
    if wide.dtype != np.float64 or np.abs(wide).max(initial=0.0) > np.finfo(np.float32).max:
        return wide
    narrow = wide.astype(np.float32)
    return narrow if np.array_equal(narrow.astype(np.float64), wide) else wide


def shipped() -> list[str]:
    """Names of the emulators that come with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob("*/emulator.json"))


def shipped_for(scene: str) -> list[str]:
    """Names of the emulators that come with the package for the built-in ``scene``."""
    return [
        name
        for name in shipped()
        if read_json(SHIPPED / name / "emulator.json")["scene"].get("scene") == scene
    ]


def load(name: str | Path, scene: Scene | None = None) -> Emulator:
    """The emulator in folder ``name``, or the shipped one of that name.

    Parameters
    ----------
    name : one of :func:`shipped`, else a folder written by :func:`save_emulator`; write ``./name``
        for a folder called like a shipped one.
    scene : the scene it must match; by default the one it was trained for is made again.

    Raises
    ------
    InputError
        Missing or damaged files, or a scene that is not the one it was trained for.
    """
    folder = SHIPPED / str(name) if str(name) in shipped() else Path(name)
    if not (folder / "emulator.json").is_file():
        raise InputError(
            f"emulator '{name}' is neither shipped nor a folder with emulator.json; "
            f"shipped: {', '.join(shipped()) or 'none'}"
        )
    description = read_json(folder / "emulator.json")
    try:
        _check_description(folder, description)
        scene = _matching_scene(name, description, scene)
        arrays = _arrays(folder / "weights.safetensors", description["weights_sha256"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder}/emulator.json lacks or garbles {error}") from error
    parts = {
        name: _restore(folder, name, scene, part, inside(arrays, name))
        for name, part in description["parts"].items()
    }
    return Emulator(scene, **parts, record=description.get("record", {}))


def _restore(
    folder: Path,
    name: str,
    scene: Scene,
    description: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> Any:
    """The part ``name``; errors name the folder and the part."""
    try:
        return PARTS[name].restore(scene, description, arrays)
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder}: its part '{name}' lacks or garbles {error}") from error
    except InputError as error:
        raise InputError(f"{folder}: its part '{name}': {error}") from error


def _check_description(folder: Path, description: Mapping[str, Any]) -> None:
    if description["format"] != FORMAT:
        raise InputError(
            f"{folder}/emulator.json has format {description['format']}; this version reads "
            f"{FORMAT}: train the emulator again"
        )
    unknown = [name for name in description["parts"] if name not in PARTS]
    if unknown:
        raise InputError(
            f"{folder}/emulator.json: part '{unknown[0]}' is unknown; known: {', '.join(PARTS)}"
        )


def _matching_scene(name: str | Path, description: Mapping[str, Any], scene: Scene | None) -> Scene:
    """``scene``, or the one the emulator was trained for, if its fingerprint is the emulator's."""
    fingerprint = description["fingerprint"]
    scene = scene_from_origin(description["scene"]) if scene is None else scene
    if scene.fingerprint != fingerprint:
        raise InputError(
            f"emulator '{name}' was trained for a scene with fingerprint {fingerprint}; "
            f"'{scene.name}' has {scene.fingerprint}: train one for this scene"
        )
    return scene


def _arrays(path: Path, digest: str) -> dict[str, np.ndarray]:
    arrays, _ = read_arrays(path)
    if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
        raise InputError(f"{path} is not the file emulator.json was written with")
    return arrays


def _build(made_of: Ingredients, _: Options) -> ForwardMap:
    """The emulator named, or the one shipped for the scene."""
    name = made_of.scene.name if made_of.emulator is None else made_of.emulator
    return made_of.ranged(load(name, made_of.scene).cache())


EMULATOR = ForwardKind(
    "emulator", "a trained emulator, shipped or in a folder", _build, from_emulator=True
)
