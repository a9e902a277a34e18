r"""The emulator of a scene: a network, and how its output becomes a displacement.

.. math:: u_i(\theta) = \bar u_i \quad\text{where held},\qquad
          u_i(\theta) = u_{0,i} + s\, \text{net}_i(\theta) \quad\text{where free}

with offset :math:`u_0` (one FEM solution at the middle of the parameter box, or zero) and a scale
:math:`s` per component. The network's last layer starts at zero, so training starts at the offset.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.forward import Prediction, all_nodes, check_nodes, inside_only, rows_of
from emulator.network.graph import AugmentedGraph
from emulator.network.pignn import Architecture, Decoder, build
from emulator.scenes.scene import Scene

# Positions in the box are uniform on [0, 1]; this gives them standard deviation 1 (Eq. 25).
_UNIT_SPREAD = 12.0**0.5


@dataclass(frozen=True, eq=False)
class Emulator:
    """A trained (or fresh) emulator.

    Parameters
    ----------
    scene : what it emulates.
    architecture : sizes of the network.
    graph : the augmented graph of the scene's mesh.
    weights : state of the network, an NNX ``State``.
    offset : (n, 3) mm.
    scale : (3,) mm.
    record : how it was trained, plain JSON.
    """

    scene: Scene
    architecture: Architecture
    graph: AugmentedGraph
    weights: nnx.State
    offset: np.ndarray
    scale: np.ndarray
    record: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the weights, the offset and the scale."""
        digest = hashlib.sha256()
        for leaf in (*jax.tree.leaves(self.weights), self.offset, self.scale):
            digest.update(np.ascontiguousarray(leaf).tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def definition(self) -> nnx.GraphDef:
        """The network without its weights."""
        return definition(self.architecture, self.graph, len(self.scene.parameters))

    def normalise(self, theta: jax.Array) -> jax.Array:
        """Theta (..., p) as the network sees it, float32."""
        return ((self.scene.to_unit(theta) - 0.5) * _UNIT_SPREAD).astype(jnp.float32)

    def displace(self, raw: jax.Array, nodes: np.ndarray) -> jax.Array:
        """Displacement (..., k, 3) in mm, float64, from raw output at ``nodes`` (k,)."""
        held, values = self.scene.prescribed
        free = self.offset[nodes] + self.scale * raw.astype(jnp.float64)
        return jnp.where(held[nodes], values[nodes], free)

    def predict(self, weights: nnx.State, thetas: jax.Array) -> jax.Array:
        """Displacements (b, n, 3) at ``thetas`` (b, p) with one pass of the processor."""
        network = nnx.merge(self.definition, weights)
        prepared = network.decoder.prepare(network.processor(self.graph))
        return self.displace(
            network.decoder(prepared, self.normalise(thetas)), all_nodes(self.scene)
        )

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (n, 3) at ``theta`` (p,), processor included; for many theta, cache."""
        return self.predict(self.weights, theta[None])[0]

    def cache(self, nodes: np.ndarray | None = None) -> CachedEmulator:
        """Run the processor once and return the forward map over ``nodes`` (all by default)."""
        nodes = all_nodes(self.scene) if nodes is None else check_nodes(self.scene, nodes)
        network = nnx.merge(self.definition, self.weights)
        prepared = jax.jit(lambda: network.decoder.prepare(network.processor(self.graph)))()
        return CachedEmulator(self, network.decoder, prepared[:, nodes], nodes)


def definition(architecture: Architecture, graph: AugmentedGraph, parameters: int) -> nnx.GraphDef:
    """Structure of the network for these sizes."""
    return nnx.split(nnx.eval_shape(lambda: build(architecture, graph, parameters, 0)))[0]


def fresh(
    scene: Scene,
    graph: AugmentedGraph,
    architecture: Architecture,
    offset: np.ndarray,
    scale: np.ndarray,
    seed: int,
) -> Emulator:
    """An untrained emulator, equal to its offset for every theta."""
    weights = nnx.state(build(architecture, graph, len(scene.parameters), seed))
    return Emulator(scene, architecture, graph, weights, np.asarray(offset), np.asarray(scale))


@dataclass(frozen=True, eq=False)
class CachedEmulator:
    """The forward map that remains once the processor has run: decoding, and nothing else."""

    emulator: Emulator
    decoder: Decoder
    prepared: jax.Array
    nodes: np.ndarray

    kind = "emulator"

    @property
    def scene(self) -> Scene:
        """What is emulated."""
        return self.emulator.scene

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (..., k, 3) in mm at ``theta`` (..., p)."""
        raw = self.decoder(self.prepared, self.emulator.normalise(theta))
        return self.emulator.displace(raw, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement and whether ``theta`` is inside the box the emulator was trained on."""
        return inside_only(self, theta)

    def at(self, nodes: np.ndarray) -> CachedEmulator:
        """The same map decoding only ``nodes``, which must be among those cached."""
        rows = rows_of(self, nodes)
        return replace(self, prepared=self.prepared[:, rows], nodes=self.nodes[rows])
