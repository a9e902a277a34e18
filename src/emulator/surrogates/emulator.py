r"""The emulator of a scene, a sum of parts of which any may be absent, and its files.

.. math:: u(\theta) = \bar u \quad\text{where prescribed},\qquad
    u(\theta) = \underbrace{P\, u_c(\theta)}_\text{on a coarser mesh}
        + \underbrace{\sum_\alpha \frac{(x - x_0)^\alpha}{\alpha!}\, u_{,\alpha}
        }_\text{Taylor series of FEM at } x_0
        + \underbrace{\textstyle\sum_\alpha P_\alpha(x)\, v_\alpha}_\text{polynomial}
        + \underbrace{s\, \text{net}(x)}_\text{network}
        + \underbrace{\textstyle\sum_k c_k(x)\, \phi_k}_\text{discrepancy model}
    \quad\text{where free}

with :math:`x` the position of theta in its unit box. The sum knows its parts only as
:class:`~emulator.surrogates.part.Part`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.catalogue import scene_from_origin
from emulator.core.errors import InputError
from emulator.core.representation import TableRepr
from emulator.core.store import inside, read_arrays, read_json, save_arrays, write_json
from emulator.scenes.scene import Scene, all_nodes, check_nodes
from emulator.surrogates.coarse import Coarse
from emulator.surrogates.discrepancy import Discrepancy
from emulator.surrogates.network.family import FamilyNetwork
from emulator.surrogates.network.part import Network
from emulator.surrogates.part import CachedPart, Part
from emulator.surrogates.polynomial import Polynomial
from emulator.surrogates.protocol import (
    ForwardKind,
    ForwardMap,
    Ingredients,
    Options,
    Prediction,
    fingerprint_of,
    inside_only,
    rows_of,
)
from emulator.surrogates.taylor import Expansion

FORMAT = 3
"""The format of files: ``emulator.json`` describes, ``weights.safetensors`` has the arrays."""
SHIPPED = Path(__file__).parent.parent / "shipped"

PARTS: dict[str, type[Part]] = {
    "coarse": Coarse,
    "taylor": Expansion,
    "polynomial": Polynomial,
    "network": Network,
    "family": FamilyNetwork,
    "discrepancy": Discrepancy,
}
"""The kinds of parts in the order of the sum, by the field of :class:`Emulator`."""


@dataclass(frozen=True, eq=False, repr=False)
class Emulator(TableRepr):
    """An emulator of a scene; without any part it predicts no displacement where free.

    Parameters
    ----------
    scene : the scene that is emulated.
    coarse : the emulator of the same body on a coarser mesh.
    taylor : the Taylor series of the equilibrium; of order 0, an offset.
    polynomial : the polynomial fitted over the whole box.
    network : the graph network.
    family : the network that has learned a family of bodies, on this one.
    discrepancy : the model of what the other parts leave of FEM runs.
    record : the account of the training, plain JSON.
    """

    scene: Scene
    coarse: Coarse | None = None
    taylor: Expansion | None = None
    polynomial: Polynomial | None = None
    network: Network | None = None
    family: FamilyNetwork | None = None
    discrepancy: Discrepancy | None = None
    record: Mapping[str, Any] = field(default_factory=dict)

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return what it emulates, what it is made of, and how it was trained."""
        _, rows = self.scene.summary_rows()
        plan = self.record.get("plan", {})
        about = [("parts", " + ".join(self.parts) or "none")]
        if plan:
            about.append(("recipe", f"{plan['recipe']}, {self.record.get('seconds', 0):.0f} s"))
        return f"Emulator of '{self.scene.name}'", [*about, rows[0], rows[-1]]

    @property
    def parts(self) -> dict[str, Part]:
        """The parts that are present, in the order they are summed."""
        named = {name: getattr(self, name) for name in PARTS}
        return {name: part for name, part in named.items() if part is not None}

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the scene and of all that shapes the prediction."""
        digest = hashlib.sha256(self.scene.fingerprint.encode())
        for name, part in self.parts.items():
            digest.update(json.dumps([name, part.to_json()], sort_keys=True).encode())
            for key, array in sorted(part.arrays().items()):
                values = np.ascontiguousarray(array)
                digest.update(f"{key} {values.dtype} {values.shape}".encode())
                digest.update(values.tobytes())
        return digest.hexdigest()[:16]

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) mm at ``theta`` (p,), the network's processor included.

        For many theta, :meth:`cache`.
        """
        position = self.scene.to_unit(theta)
        free = jnp.zeros(self.scene.held.shape)
        for part in self.parts.values():
            free = free + part(position)
        return self.scene.on_supports(free, theta)

    def cache(self, nodes: np.ndarray | None = None) -> CachedEmulator:
        """Return the forward map over ``nodes``, all by default, from one processor pass."""
        nodes = all_nodes(self.scene) if nodes is None else check_nodes(self.scene, nodes)
        cached = tuple(part.cache(nodes) for part in self.parts.values())
        return CachedEmulator(self, cached, nodes)


@dataclass(frozen=True, eq=False)
class CachedEmulator:
    """An emulator over some nodes, with all evaluated that does not depend on theta.

    The modes of all parts are one matrix, so that a displacement is one product.
    """

    emulator: Emulator
    parts: tuple[CachedPart, ...]
    nodes: np.ndarray

    kind = "emulator"
    label = "emulator"

    @property
    def scene(self) -> Scene:
        """The scene that is emulated."""
        return self.emulator.scene

    @property
    def fingerprint(self) -> str:
        """Short hash of scene, emulator and nodes."""
        return fingerprint_of(
            self.kind, self.scene.fingerprint, self.emulator.fingerprint, self.nodes
        )

    @cached_property
    def _linear(self) -> tuple[np.ndarray, np.ndarray]:
        """Offset (k, 3) and modes (t, 3 k) in mm of all parts together."""
        count = len(self.nodes)
        offset = sum((part.offset for part in self.parts), np.zeros((count, 3)))
        modes = np.concatenate([np.zeros((0, count, 3)), *(part.modes for part in self.parts)])
        return offset, modes.reshape(len(modes), 3 * count)

    def coefficients(self, theta: jax.Array) -> jax.Array:
        """Return the coefficients (t,) of all parts' modes at ``theta`` (p,)."""
        position = self.scene.to_unit(theta)
        return jnp.concatenate(
            [jnp.zeros(0), *(part.coefficients(position) for part in self.parts)]
        )

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (..., k, 3) mm at ``theta`` (..., p)."""
        offset, modes = self._linear
        coefficients = jnp.vectorize(self.coefficients, signature="(p)->(t)")(theta)
        free = offset + (coefficients @ modes).reshape(*theta.shape[:-1], *offset.shape)
        for part in self.parts:
            if part.field is not None:
                free = free + part.field(self.scene.to_unit(theta))
        return self.scene.on_supports(free, theta, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement, and whether ``theta`` is inside the box of the training."""
        return inside_only(self, theta)

    def at(self, nodes: np.ndarray) -> CachedEmulator:
        """Return the same map over ``nodes``, which must be among those cached."""
        rows = rows_of(self, nodes)
        parts = tuple(part.at(rows) for part in self.parts)
        return replace(self, parts=parts, nodes=self.nodes[rows])


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
    """Return the array in float32 where that loses nothing, which halves the file."""
    wide = np.asarray(array)
    if wide.dtype != np.float64 or np.abs(wide).max(initial=0.0) > np.finfo(np.float32).max:
        return wide
    narrow = wide.astype(np.float32)
    return narrow if np.array_equal(narrow.astype(np.float64), wide) else wide


def shipped() -> list[str]:
    """Return the names of the emulators that come with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob("*/emulator.json"))


def shipped_for(scene: str) -> list[str]:
    """Return the names of the emulators that come with the package for the built-in ``scene``."""
    return [
        name
        for name in shipped()
        if read_json(SHIPPED / name / "emulator.json")["scene"].get("scene") == scene
    ]


def load(name: str | Path, scene: Scene | None = None) -> Emulator:
    """Return the emulator in folder ``name``, or the shipped one of that name.

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
    """Return the part ``name``; errors name the folder and the part."""
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
    """Return ``scene``, by default the one of the training; refuse another fingerprint."""
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


def _build(ingredients: Ingredients, _: Options) -> ForwardMap:
    """Return the emulator that is named, by default the one shipped for the scene."""
    name = ingredients.scene.name if ingredients.emulator is None else ingredients.emulator
    return ingredients.ranged(load(name, ingredients.scene).cache())


EMULATOR = ForwardKind(
    "emulator", "a trained emulator, shipped or in a folder", _build, from_emulator=True
)
