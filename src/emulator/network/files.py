"""Emulators on disk: ``emulator.json`` describes, ``weights.safetensors`` holds the arrays."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path

import jax
import jax.numpy as jnp
from flax import nnx

from emulator.errors import InputError
from emulator.network.emulator import Emulator
from emulator.network.graph import AugmentedGraph
from emulator.network.pignn import Architecture, build
from emulator.scenes.registry import scene_from_recipe
from emulator.scenes.scene import Scene
from emulator.store import fill_tree, read_arrays, read_json, save_tree, write_json

FORMAT = 1
SHIPPED = Path(__file__).parent.parent / "shipped"
_GRAPH = ("node_features", "edge_features", "senders", "receivers")


def save_emulator(emulator: Emulator, folder: str | Path) -> None:
    """Write ``emulator`` into ``folder``."""
    folder = Path(folder)
    arrays = {
        "weights": nnx.to_pure_dict(emulator.weights),
        "graph": {name: getattr(emulator.graph, name) for name in _GRAPH},
        "offset": emulator.offset,
        "scale": emulator.scale,
    }
    digest = save_tree(folder / "weights.safetensors", arrays)
    write_json(
        folder / "emulator.json",
        {
            "format": FORMAT,
            "scene": dict(emulator.scene.recipe),
            "fingerprint": emulator.scene.fingerprint,
            "architecture": asdict(emulator.architecture),
            "weights_sha256": digest,
            "record": dict(emulator.record),
        },
    )


def shipped() -> list[str]:
    """Names of the emulators that come with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob("*/emulator.json"))


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
        if description["format"] != FORMAT:
            raise InputError(
                f"{folder}/emulator.json has format {description['format']}; "
                f"this version reads {FORMAT}"
            )
        sizes = description["architecture"]
        architecture = Architecture(sizes["steps"], sizes["latent"], tuple(sizes["hidden"]))
        fingerprint, digest = description["fingerprint"], description["weights_sha256"]
        scene = scene_from_recipe(description["scene"]) if scene is None else scene
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder}/emulator.json lacks or garbles {error}") from error
    if scene.fingerprint != fingerprint:
        raise InputError(
            f"emulator '{name}' was trained for a scene with fingerprint {fingerprint}; "
            f"'{scene.name}' has {scene.fingerprint}: train one for this scene"
        )
    return _read(folder, scene, architecture, digest, description.get("record", {}))


def _read(
    folder: Path, scene: Scene, architecture: Architecture, digest: str, record: dict
) -> Emulator:
    path = folder / "weights.safetensors"
    arrays, _ = read_arrays(path)
    if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
        raise InputError(f"{path} is not the file emulator.json was written with")
    stored = {name: arrays[f"['graph']['{name}']"] for name in _GRAPH}
    graph = AugmentedGraph(**stored, real=len(scene.mesh.nodes))
    state = nnx.state(nnx.eval_shape(lambda: build(architecture, graph, len(scene.parameters), 0)))
    pure = fill_tree({"weights": nnx.to_pure_dict(state)}, arrays, str(path))["weights"]
    nnx.replace_by_pure_dict(state, jax.tree.map(jnp.asarray, pure))
    return Emulator(
        scene, architecture, graph, state, arrays["['offset']"], arrays["['scale']"], record
    )
