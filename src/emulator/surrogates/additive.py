r"""The emulator of a scene: a sum of parts, any of which may be absent.

.. math:: u(\theta) = \bar u \quad\text{where held},\qquad
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
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.representation import TableRepr
from emulator.scenes.scene import Scene, all_nodes, check_nodes
from emulator.surrogates.coarse import Coarse
from emulator.surrogates.discrepancy import Discrepancy
from emulator.surrogates.network.family import FamilyNetwork
from emulator.surrogates.network.part import Network
from emulator.surrogates.part import CachedPart, Part
from emulator.surrogates.polynomial import Polynomial
from emulator.surrogates.protocol import Prediction, fingerprint_of, inside_only, rows_of
from emulator.surrogates.taylor import Expansion

PARTS: dict[str, type[Part]] = {
    "coarse": Coarse,
    "taylor": Expansion,
    "polynomial": Polynomial,
    "network": Network,
    "family": FamilyNetwork,
    "discrepancy": Discrepancy,
}
"""The kinds of parts, in the order they are summed, by the field of :class:`Emulator` that holds
them."""


@dataclass(frozen=True, eq=False, repr=False)
class Emulator(TableRepr):
    """An emulator of a scene; without any part it predicts no displacement where free.

    Parameters
    ----------
    scene : what it emulates.
    coarse : emulator of the same body on a coarser mesh.
    taylor : Taylor series of the equilibrium; of order 0, an offset.
    polynomial : fitted over the whole box.
    network : graph network.
    family : network that has learned a family of bodies, on this one.
    discrepancy : model of what FEM runs showed the other parts to leave.
    record : how it was trained, plain JSON.
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
        """What it emulates, what it is made of, how it was trained."""
        _, rows = self.scene.summary_rows()
        plan = self.record.get("plan", {})
        made = [("parts", " + ".join(self.parts) or "none")]
        if plan:
            made.append(("recipe", f"{plan['recipe']}, {self.record.get('seconds', 0):.0f} s"))
        return f"Emulator of '{self.scene.name}'", [*made, rows[0], rows[-1]]

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
        """Displacement (n, 3) in mm at ``theta`` (p,), the network's processor included.

        For many theta, :meth:`cache`.
        """
        position = self.scene.to_unit(theta)
        free = jnp.zeros(self.scene.held.shape)
        for part in self.parts.values():
            free = free + part(position)
        return self.scene.on_supports(free, theta)

    def cache(self, nodes: np.ndarray | None = None) -> CachedEmulator:
        """The forward map over ``nodes`` (all by default); runs the network's processor once."""
        nodes = all_nodes(self.scene) if nodes is None else check_nodes(self.scene, nodes)
        cached = tuple(part.cache(nodes) for part in self.parts.values())
        return CachedEmulator(self, cached, nodes)


@dataclass(frozen=True, eq=False)
class CachedEmulator:
    """An emulator over some nodes, everything that does not depend on theta evaluated.

    The modes of all parts are one matrix, so that a displacement is one product.
    """

    emulator: Emulator
    parts: tuple[CachedPart, ...]
    nodes: np.ndarray

    kind = "emulator"
    label = "emulator"

    @property
    def scene(self) -> Scene:
        """What is emulated."""
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
        """Coefficients (t,) of all parts' modes at ``theta`` (p,)."""
        position = self.scene.to_unit(theta)
        return jnp.concatenate(
            [jnp.zeros(0), *(part.coefficients(position) for part in self.parts)]
        )

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (..., k, 3) in mm at ``theta`` (..., p)."""
        offset, modes = self._linear
        coefficients = jnp.vectorize(self.coefficients, signature="(p)->(t)")(theta)
        free = offset + (coefficients @ modes).reshape(*theta.shape[:-1], *offset.shape)
        for part in self.parts:
            if part.field is not None:
                free = free + part.field(self.scene.to_unit(theta))
        return self.scene.on_supports(free, theta, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement and whether ``theta`` is inside the box the emulator was trained on."""
        return inside_only(self, theta)

    def at(self, nodes: np.ndarray) -> CachedEmulator:
        """The same map over ``nodes``, which must be among those cached."""
        rows = rows_of(self, nodes)
        parts = tuple(part.at(rows) for part in self.parts)
        return replace(self, parts=parts, nodes=self.nodes[rows])
