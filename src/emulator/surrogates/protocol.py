"""Forward maps: whatever takes theta to displacement. Calibration sees nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.scenes.scene import Scene


class Prediction(NamedTuple):
    """Displacement (k, 3) in mm of a forward map's nodes, and whether it may be used, () bool."""

    displacement: jax.Array
    valid: jax.Array


class ForwardMap(Protocol):
    """Theta to displacement, differentiable, usable under ``jit`` and ``vmap``.

    kind : short name, e.g. ``emulator`` or ``fem``.
    scene : what it maps.
    nodes : (k,) the nodes it returns, in order.
    """

    @property
    def kind(self) -> str:
        """Short name."""
        ...

    @property
    def scene(self) -> Scene:
        """What is mapped."""
        ...

    @property
    def nodes(self) -> np.ndarray:
        """Nodes returned, (k,)."""
        ...

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (k, 3) in mm at ``theta`` (p,)."""
        ...

    def evaluate(self, theta: jax.Array) -> Prediction:
        """The same with its validity, for use inside a density."""
        ...

    def at(self, nodes: np.ndarray) -> ForwardMap:
        """The same map restricted to ``nodes``; a fast map then computes only those."""
        ...


def all_nodes(scene: Scene) -> np.ndarray:
    """Indices of every node of the scene, (n,)."""
    return np.arange(len(scene.mesh.nodes))


def check_nodes(scene: Scene, nodes: np.ndarray) -> np.ndarray:
    """``nodes`` as integers; :class:`InputError` unless each is a node of the scene."""
    nodes = np.atleast_1d(np.asarray(nodes))
    if nodes.size == 0 or not np.issubdtype(nodes.dtype, np.integer):
        raise InputError("observed nodes must be a list of whole numbers, not empty")
    unknown = nodes[(nodes < 0) | (nodes >= len(scene.mesh.nodes))]
    if unknown.size:
        raise InputError(
            f"node {unknown[0]} is unknown; scene '{scene.name}' has nodes 0 to "
            f"{len(scene.mesh.nodes) - 1}"
        )
    return nodes


def inside_only(forward: ForwardMap, theta: jax.Array) -> Prediction:
    """``forward(theta)``, valid inside the box; outside it the value at the box's centre.

    A map fitted inside the box means nothing outside, and may not even be finite there: its
    gradient would reach a sampler through the branch not taken.
    """
    inside = forward.scene.space.contains(theta)
    safe = jnp.where(inside[..., None], theta, forward.scene.centre)
    return Prediction(forward(safe), inside)


@dataclass(frozen=True, eq=False)
class Extrapolated:
    """``base``, taken at its word outside the box too, wherever it is finite.

    To measure how fast a map gets worse there; never to calibrate with.
    """

    base: ForwardMap

    @property
    def kind(self) -> str:
        """That of ``base``."""
        return self.base.kind

    @property
    def scene(self) -> Scene:
        """What is mapped."""
        return self.base.scene

    @property
    def nodes(self) -> np.ndarray:
        """Nodes returned, (k,)."""
        return self.base.nodes

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (k, 3) in mm."""
        return self.base(theta)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement (k, 3) in mm, and whether it is finite."""
        u = self.base(theta)
        return Prediction(u, jnp.all(jnp.isfinite(u)))

    def at(self, nodes: np.ndarray) -> Extrapolated:
        """The same map restricted to ``nodes``."""
        return Extrapolated(self.base.at(nodes))


def rows_of(forward: ForwardMap, nodes: np.ndarray) -> np.ndarray:
    """Positions of ``nodes`` among those of ``forward``; :class:`InputError` when one is not."""
    nodes = check_nodes(forward.scene, nodes)
    position = {int(node): k for k, node in enumerate(forward.nodes)}
    missing = [int(node) for node in nodes if int(node) not in position]
    if missing:
        raise InputError(
            f"node {missing[0]} is not among the {len(position)} this {forward.kind} map returns"
        )
    return np.array([position[int(node)] for node in nodes])
