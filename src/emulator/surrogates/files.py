"""Emulators on disk: ``emulator.json`` describes, ``weights.safetensors`` holds the arrays."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.catalogue import scene_from_origin
from emulator.errors import InputError
from emulator.scenes.scene import Scene
from emulator.store import fill_tree, read_arrays, read_json, save_tree, write_json
from emulator.surrogates.additive import BASES, Emulator
from emulator.surrogates.discrepancy import Residual
from emulator.surrogates.discrepancy.fit import Warp
from emulator.surrogates.kind import ForwardKind, Ingredients, Options
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import Architecture, build
from emulator.surrogates.protocol import ForwardMap
from emulator.surrogates.taylor import Expansion, constant

FORMAT = 2
_READABLE = (1, 2)  # 1 had an offset where there is a series now, and no residual
SHIPPED = Path(__file__).parent.parent / "shipped"
_GRAPH = ("node_features", "edge_features", "senders", "receivers")
_SERIES = ("centre", "displacement", "indices", "derivatives")
_RESIDUAL = ("known", "values", "slopes", "offset", "modes")


def save_emulator(emulator: Emulator, folder: str | Path) -> None:
    """Write ``emulator`` into ``folder``."""
    folder = Path(folder)
    arrays: dict[str, Any] = {
        "weights": nnx.to_pure_dict(emulator.weights),
        "graph": {name: getattr(emulator.graph, name) for name in _GRAPH},
        "series": {name: _narrow(getattr(emulator.series, name)) for name in _SERIES},
        "scale": emulator.scale,
        "basis": emulator.basis,
    }
    if emulator.residual is not None:
        arrays["residual"] = {
            "warp": emulator.residual.warp._asdict(),
            **{name: _narrow(getattr(emulator.residual, name)) for name in _RESIDUAL},
        }
    digest = save_tree(folder / "weights.safetensors", arrays)
    write_json(
        folder / "emulator.json",
        {
            "format": FORMAT,
            "scene": dict(emulator.scene.origin),
            "fingerprint": emulator.scene.fingerprint,
            "architecture": asdict(emulator.architecture),
            "base": emulator.base,
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
        if description["format"] not in _READABLE:
            raise InputError(
                f"{folder}/emulator.json has format {description['format']}; "
                f"this version reads {', '.join(map(str, _READABLE))}"
            )
        sizes = description["architecture"]
        architecture = Architecture(**{**sizes, "hidden": tuple(sizes["hidden"])})
        fingerprint, base = description["fingerprint"], description.get("base", "network")
        if base not in BASES:
            raise InputError(f"{folder}/emulator.json: base '{base}'; expected {', '.join(BASES)}")
        scene = scene_from_origin(description["scene"]) if scene is None else scene
        if scene.fingerprint != fingerprint:
            raise InputError(
                f"emulator '{name}' was trained for a scene with fingerprint {fingerprint}; "
                f"'{scene.name}' has {scene.fingerprint}: train one for this scene"
            )
        arrays = _arrays(folder / "weights.safetensors", description["weights_sha256"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder}/emulator.json lacks or garbles {error}") from error
    try:
        return _assemble(scene, architecture, arrays, base, description.get("record", {}))
    except KeyError as error:
        raise InputError(f"{folder}/weights.safetensors: array {error} is missing") from error


def _arrays(path: Path, digest: str) -> dict[str, np.ndarray]:
    arrays, _ = read_arrays(path)
    if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
        raise InputError(f"{path} is not the file emulator.json was written with")
    return arrays


def _assemble(
    scene: Scene, architecture: Architecture, arrays: dict[str, np.ndarray], base: Any, record: dict
) -> Emulator:
    stored = {name: arrays[f"['graph']['{name}']"] for name in _GRAPH}
    graph = AugmentedGraph(**stored, real=len(scene.mesh.nodes))
    basis = arrays.get("['basis']", np.zeros((0, *scene.held.shape), dtype=np.float32))
    state = nnx.state(
        nnx.eval_shape(lambda: build(architecture, graph, len(scene.parameters), len(basis), 0))
    )
    pure = fill_tree({"weights": nnx.to_pure_dict(state)}, arrays, "weights.safetensors")
    nnx.replace_by_pure_dict(state, jax.tree.map(jnp.asarray, pure["weights"]))
    return Emulator(
        scene=scene,
        architecture=architecture,
        graph=graph,
        weights=state,
        series=_series(scene, arrays),
        scale=arrays["['scale']"],
        basis=basis,
        residual=_residual(arrays),
        base=base,
        record=record,
    )


def _wide(array: np.ndarray) -> np.ndarray:
    """Floating point numbers in float64, whatever they were kept in."""
    return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else array


def _series(scene: Scene, arrays: dict[str, np.ndarray]) -> Expansion:
    if "['offset']" in arrays:
        return constant(np.full(len(scene.parameters), 0.5), jnp.asarray(arrays["['offset']"]))
    centre, u, indices, derivatives = (_wide(arrays[f"['series']['{name}']"]) for name in _SERIES)
    return Expansion(centre, jnp.asarray(u), indices, jnp.asarray(derivatives))


def _residual(arrays: dict[str, np.ndarray]) -> Residual | None:
    if "['residual']['modes']" not in arrays:
        return None
    parts = {name: jnp.asarray(_wide(arrays[f"['residual']['{name}']"])) for name in _RESIDUAL}
    centre, indices, coefficients, lengths = (
        _wide(arrays[f"['residual']['warp']['{name}']"]) for name in Warp._fields
    )
    warp = Warp(centre, indices, jnp.asarray(coefficients), jnp.asarray(lengths))
    return Residual(warp=warp, **parts)


def _build(made_of: Ingredients, _: Options) -> ForwardMap:
    """The emulator named, or the one shipped for the scene."""
    name = made_of.scene.name if made_of.emulator is None else made_of.emulator
    return made_of.ranged(load(name, made_of.scene).cache())


EMULATOR = ForwardKind(
    "emulator", "a trained emulator, shipped or in a folder", _build, from_emulator=True
)
