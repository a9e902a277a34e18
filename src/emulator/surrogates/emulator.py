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
:class:`~emulator.surrogates.part.EmulatorPart`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_array, eye_array

from emulator.catalogue import scene_from_origin
from emulator.core.display import TableRepr
from emulator.core.errors import InputError, check_known, look_up
from emulator.core.rooms import offered
from emulator.core.store import inside, narrow, read_arrays, read_json, save_arrays, write_json
from emulator.fem.reactions import SupportForce
from emulator.geometry.facets import Cavity
from emulator.scenes.scene import Scene, all_nodes, check_nodes, with_mesh
from emulator.surrogates.coarse import Coarse
from emulator.surrogates.discrepancy import Discrepancy
from emulator.surrogates.folders import KINDS, folder_of
from emulator.surrogates.network import Network
from emulator.surrogates.part import CachedPart, EmulatorPart, arrays_of, together
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
from emulator.surrogates.support_work import SupportWork, amount_of
from emulator.surrogates.taylor import Expansion

if TYPE_CHECKING:
    from emulator.surrogates.network.family import FamilyNetwork

FORMAT = 3
"""The format of files: ``emulator.json`` describes, ``weights.safetensors`` has the arrays."""

_FAMILY = offered("emulator.surrogates.network.family", "FamilyNetwork")
PARTS: dict[str, type[EmulatorPart]] = {
    "coarse": Coarse,
    "taylor": Expansion,
    "polynomial": Polynomial,
    "network": Network,
    **dict(zip(["family"], _FAMILY, strict=False)),
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
        """Return rows about the scene, the parts and the training of the emulator."""
        _, rows = self.scene.summary_rows()
        plan = self.record.get("plan", {})
        about = [("parts", " + ".join(self.parts) or "none")]
        if plan:
            about.append(("recipe", f"{plan['recipe']}, {self.record.get('seconds', 0):.0f} s"))
        return f"Emulator of '{self.scene.name}'", [*about, rows[0], rows[-1]]

    @property
    def parts(self) -> dict[str, EmulatorPart]:
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
        cached = [part.cache(nodes) for part in self.parts.values()]
        return CachedEmulator(self, together(cached, len(nodes)), nodes)

    @cached_property
    def _works(self) -> dict[tuple[str, tuple[float, float, float]], SupportWork | None]:
        """The works of supports that were asked for, by name and direction."""
        return {}

    def work_of(self, force: SupportForce) -> SupportWork | None:
        """Return the force of a support from the work of the whole body; None where it is not."""
        key = force.name, force.direction
        if key not in self._works:
            amount = amount_of(force)
            with jax.ensure_compile_time_eval():  # a caller may be traced
                self._works[key] = (
                    None if amount is None else SupportWork(self.cache(), force, amount)
                )
        return self._works[key]


@dataclass(frozen=True, eq=False)
class CachedEmulator:
    """An emulator over some nodes, with all evaluated that does not depend on theta.

    The modes of all its parts are one matrix of ``part``, so that a displacement is one product.
    """

    emulator: Emulator
    part: CachedPart
    nodes: np.ndarray

    kind = "emulator"

    @property
    def label(self) -> str:
        """``graph network`` where all but an offset is one."""
        series, parts = self.emulator.taylor, set(self.emulator.parts)
        if series is not None and series.order == 0:
            parts.remove("taylor")
        return "graph network" if parts in ({"network"}, {"family"}) else "emulator"

    @property
    def scene(self) -> Scene:
        """The scene that is emulated."""
        return self.emulator.scene

    @property
    def fingerprint(self) -> str:
        """Short hash of scene, emulator and nodes."""
        prints = self.scene.fingerprint, self.emulator.fingerprint
        return fingerprint_of(self.kind, *prints, self.nodes)

    def coefficients(self, theta: jax.Array) -> jax.Array:
        """Return the coefficients (t,) of all parts' modes at ``theta`` (p,)."""
        return self.part.coefficients(self.scene.to_unit(theta))

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (..., k, 3) mm at ``theta`` (..., p)."""
        part, shape = self.part, self.part.offset.shape
        coefficients = jnp.vectorize(self.coefficients, signature="(p)->(t)")(theta)
        free = coefficients @ part.modes.reshape(-1, shape[0] * 3)
        free = part.offset + free.reshape(*theta.shape[:-1], *shape)
        if part.decode is not None and part.prepared is not None:
            free = free + part.decode(part.prepared, self.scene.to_unit(theta))
        return self.scene.on_supports(free, theta, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement, and whether ``theta`` is inside the box of the training."""
        return inside_only(self, theta)

    def seen_through(self, matrix: csr_array) -> Callable[[jax.Array], Any] | None:
        """Return a function of theta (p,): the values (r,) of ``matrix @ u``, and their validity.

        matrix : (r, 3 k), of the displacement u (3 k,) of the nodes. It is multiplied by the modes
            once, so that nothing else of the displacement is computed.

        None where the displacement is not a sum of modes.
        """
        if self.part.decode is not None:
            return None
        offset, modes = self._modes_through(csr_array(matrix))

        def values(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
            return offset + modes @ self._amounts(theta), self.scene.space.contains(theta)

        return values

    def volume(self, cavity: Cavity) -> Callable[[jax.Array], jax.Array] | None:
        """Return the volume () in mL of ``cavity`` as a function of theta (p,), from coefficients.

        Outside the box it is the volume at the centre. None where the displacement is not a sum of
        modes, or of so many that their pairs outnumber the wall's displacements: the integral over
        the wall is then less work.
        """
        wall, count = self.at(cavity.nodes), 3 * len(cavity.nodes)
        if wall.part.decode is not None or 0.5 * len(wall.part.modes) ** 2 > count:
            return None
        offset, modes = wall._modes_through(csr_array(eye_array(count)))
        of_amounts = cavity.of_modes(offset.reshape(-1, 3), modes.T.reshape(-1, count // 3, 3))
        return lambda theta: of_amounts(wall._amounts(theta))

    def _modes_through(self, matrix: csr_array) -> tuple[np.ndarray, np.ndarray]:
        """Return an offset (r,) and modes (r, t): ``matrix @ u`` of :meth:`_amounts`."""
        part, scene = self.part, self.scene
        held = scene.held[self.nodes].ravel()
        free = csr_array(matrix.multiply(~held[None]))
        prescribed = [
            matrix @ np.where(held, displacement[self.nodes].ravel(), 0.0)
            for displacement in scene.prescribed.per_unit.values()
        ]
        fixed = matrix @ np.where(held, scene.held_displacement[self.nodes].ravel(), 0.0)
        modes = free @ part.modes.reshape(-1, free.shape[1]).T
        return free @ part.offset.ravel() + fixed, np.column_stack([modes, *prescribed])

    def _amounts(self, theta: jax.Array) -> jax.Array:
        """Return the coefficients (t,) of modes and of supports that move, inside the box."""
        scene = self.scene
        safe = jnp.where(scene.space.contains(theta), theta, scene.centre)
        at = scene.resolve(safe)
        moving = [at[name] for name in scene.prescribed.per_unit]
        return jnp.concatenate([self.coefficients(safe), jnp.array(moving)])

    def support_force(self, force: SupportForce) -> Callable[[jax.Array], jax.Array] | None:
        """Return ``force`` in mN as a function of theta (p,), from the work of the whole body.

        Outside the box it is the force at the centre. None where no parameter moves the support
        along the force (:mod:`emulator.surrogates.support_work`).
        """
        if (work := self.emulator.work_of(force)) is None:
            return None
        scene = self.scene
        return lambda theta: work(jnp.where(scene.space.contains(theta), theta, scene.centre))

    def at(self, nodes: np.ndarray) -> CachedEmulator:
        """Return this map restricted to ``nodes``, which must be among its nodes."""
        rows = rows_of(self, nodes)
        return replace(self, part=self.part.at(rows), nodes=self.nodes[rows])


def save_emulator(emulator: Emulator, folder: str | Path) -> None:
    """Write ``emulator`` into ``folder``; :class:`InputError` for one without any part."""
    folder = Path(folder)
    if not emulator.parts:
        raise InputError("an emulator without any part has nothing to save")
    arrays = {name: narrow(array) for name, array in arrays_of(emulator.parts).items()}
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


def load(name: str | Path, scene: Scene | None = None, *, kind: str | None = None) -> Emulator:
    """Return the emulator in folder ``name``, or the shipped one of that name.

    Parameters
    ----------
    name : the name of a shipped emulator, else a folder written by :func:`save_emulator`; write
        ``./name`` for a folder called like a shipped one. The graph network of a built-in scene has
        the scene's name.
    kind : ``series`` or ``physics``, for another shipped emulator of the scene called ``name``
        (:mod:`emulator.surrogates.folders`).
    scene : the scene it must match; by default the one it was trained for is made again. A network
        that has learned a family of bodies, and stands alone, is taken to the scene's.

    Raises
    ------
    InputError
        Missing or damaged files, or a scene that is not the one it was trained for.
    """
    if kind is not None:
        check_known(kind, KINDS, "kind")
        name = f"{name}_{kind}"
    folder = folder_of(name)
    file, weights = folder / "emulator.json", folder / "weights.safetensors"
    description = read_json(file)
    try:
        if description["format"] != FORMAT:
            raise InputError(
                f"{file} has format {description['format']}; this version reads {FORMAT}: train "
                "the emulator again"
            )
        kinds = {part: look_up(PARTS, part, f"{file}: part") for part in description["parts"]}
        scene = scene_from_origin(description["scene"]) if scene is None else scene
        other = scene.fingerprint != description["fingerprint"]
        if other and set(kinds) != {"family"}:  # what was learned on a body stays on it
            raise InputError(
                f"emulator '{name}' was trained for a scene with fingerprint "
                f"{description['fingerprint']}; '{scene.name}' has {scene.fingerprint}: train one "
                "for this scene"
            )
        arrays, _ = read_arrays(weights)
        if hashlib.sha256(weights.read_bytes()).hexdigest() != description["weights_sha256"]:
            raise InputError(f"{weights} is not the file emulator.json was written with")
    except (KeyError, TypeError) as error:
        raise InputError(f"{file} lacks or garbles {error}") from error
    parts: dict[str, Any] = {}
    for part, part_kind in kinds.items():
        try:
            parts[part] = part_kind.restore(scene, description["parts"][part], inside(arrays, part))
        except (KeyError, TypeError) as error:
            raise InputError(f"{folder}: its part '{part}' lacks or garbles {error}") from error
        except InputError as error:
            raise InputError(f"{folder}: its part '{part}': {error}") from error
    if other:
        parts["family"] = parts["family"].on(scene)
    return Emulator(scene, **parts, record=description.get("record", {}))


def _build(ingredients: Ingredients, _: Options) -> ForwardMap:
    scene = with_mesh(ingredients.scene)
    kind = ingredients.emulator if ingredients.emulator in KINDS else None
    name = ingredients.emulator if kind is None else None
    return load(name or scene.name, scene, kind=kind).cache()


EMULATOR = ForwardKind(
    "emulator", "a trained emulator, shipped or in a folder", _build, words=("emulator",)
)
