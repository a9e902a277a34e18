r"""The emulator of a scene: what it is made of, and how that becomes a displacement.

.. math:: u(\theta) = \bar u \quad\text{where held},\qquad
    u(\theta) = \underbrace{\sum_\alpha \frac{(x - x_0)^\alpha}{\alpha!}\, u_{,\alpha}
        }_\text{Taylor series of FEM at } x_0
        + \underbrace{s\, \text{net}(\theta)}_\text{network}
        + \underbrace{\textstyle\sum_k c_k(x)\, \phi_k}_\text{residual}
    \quad\text{where free}

with :math:`x` theta's position in its box. Each part may be missing: a series of order 0 is a
constant, which may be zero; the network's last layer starts at zero; the residual comes from FEM
runs. ``base`` says how much of it the residual was fitted on top of, and only that is evaluated.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.scenes.scene import Scene
from emulator.surrogates.discrepancy import Residual
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import (
    Architecture,
    Decoder,
    PointwiseDecoder,
    SeparableDecoder,
    build,
)
from emulator.surrogates.protocol import (
    Prediction,
    all_nodes,
    check_nodes,
    fingerprint_of,
    inside_only,
    rows_of,
)
from emulator.surrogates.taylor import Expansion

# Positions in the box are uniform on [0, 1]; this gives them standard deviation 1 (Eq. 25).
_UNIT_SPREAD = 12.0**0.5

Base = Literal["nothing", "series", "network"]
BASES: tuple[Base, ...] = ("nothing", "series", "network")


@dataclass(frozen=True, eq=False)
class Emulator:
    """A trained (or fresh) emulator.

    Parameters
    ----------
    scene : what it emulates.
    architecture : sizes of the network.
    graph : the augmented graph of the scene's mesh.
    weights : state of the network, an NNX ``State``.
    series : Taylor series of the equilibrium; of order 0, an offset.
    scale : (3,) mm, of the network's output.
    basis : (f, n, 3) in units of ``scale``, modes given to a separable decoder.
    residual : what FEM runs taught, or None.
    base : what the residual is added to; ``network`` is series and network.
    record : how it was trained, plain JSON.
    """

    scene: Scene
    architecture: Architecture
    graph: AugmentedGraph
    weights: nnx.State
    series: Expansion
    scale: np.ndarray
    basis: np.ndarray
    residual: Residual | None = None
    base: Base = "network"
    record: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of all that shapes the prediction."""
        digest = hashlib.sha256(self.base.encode())
        parts = (self.weights, vars(self.series), self.scale, self.basis)
        residual = () if self.residual is None else vars(self.residual)
        for leaf in jax.tree.leaves((parts, residual)):
            digest.update(np.ascontiguousarray(leaf).tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def definition(self) -> nnx.GraphDef:
        """The network without its weights."""
        return definition(
            self.architecture, self.graph, len(self.scene.parameters), len(self.basis)
        )

    def normalise(self, theta: jax.Array) -> jax.Array:
        """Theta (..., p) as the network sees it, float32."""
        return ((self.scene.to_unit(theta) - 0.5) * _UNIT_SPREAD).astype(jnp.float32)

    def hold(self, free: jax.Array, nodes: np.ndarray) -> jax.Array:
        """Displacement (..., k, 3) in mm at ``nodes`` (k,), known where it is held."""
        held, values = self.scene.prescribed
        return jnp.where(held[nodes], values[nodes], free)

    def prepared(self, weights: nnx.State) -> tuple[Decoder, jax.Array]:
        """The decoder, and what it keeps of one pass of the processor."""
        network = nnx.merge(self.definition, weights)
        states = network.processor(self.graph)
        return network.decoder, network.decoder.prepare(states, jnp.asarray(self.basis))

    def decode(self, decoder: Decoder, prepared: jax.Array, thetas: jax.Array) -> jax.Array:
        """Series and network (b, n, 3) at ``thetas`` (b, p), from what :meth:`prepared` gave."""
        raw = decoder(prepared, self.normalise(thetas))
        free = self.series(self.scene.to_unit(thetas)) + self.scale * raw.astype(jnp.float64)
        return self.hold(free, all_nodes(self.scene))

    def predict(self, weights: nnx.State, thetas: jax.Array) -> jax.Array:
        """The same with one pass of the processor."""
        return self.decode(*self.prepared(weights), thetas)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (n, 3) at ``theta`` (p,), processor included; for many theta, cache."""
        position = self.scene.to_unit(theta)
        free = jnp.zeros(self.scene.held.shape)
        if self.base == "network":
            free = self.predict(self.weights, theta[None])[0]
        elif self.base == "series":
            free = self.series(position)
        if self.residual is not None:
            free = free + self.residual(position)
        return self.hold(free, all_nodes(self.scene))

    def cache(self, nodes: np.ndarray | None = None) -> CachedEmulator:
        """Run the processor once and return the forward map over ``nodes`` (all by default)."""
        nodes = all_nodes(self.scene) if nodes is None else check_nodes(self.scene, nodes)
        if self.base != "network":
            return CachedEmulator(self, None, None, nodes)
        graph, state = nnx.split(nnx.merge(self.definition, self.weights).decoder)
        prepared = jax.jit(lambda: self.prepared(self.weights)[1])()
        return CachedEmulator(self, nnx.merge(graph, state), prepared[:, nodes], nodes)


def definition(
    architecture: Architecture, graph: AugmentedGraph, parameters: int, fixed: int
) -> nnx.GraphDef:
    """Structure of the network for these sizes."""
    return nnx.split(nnx.eval_shape(lambda: build(architecture, graph, parameters, fixed, 0)))[0]


def fresh(
    scene: Scene,
    graph: AugmentedGraph,
    architecture: Architecture,
    series: Expansion,
    scale: np.ndarray,
    seed: int,
    basis: np.ndarray | None = None,
) -> Emulator:
    """An untrained emulator, equal to its series for every theta."""
    if basis is None:
        basis = np.zeros((0, *scene.held.shape), dtype=np.float32)
    weights = nnx.state(build(architecture, graph, len(scene.parameters), len(basis), seed))
    return Emulator(scene, architecture, graph, weights, series, np.asarray(scale), basis)


@dataclass(frozen=True, eq=False)
class CachedEmulator:
    """The forward map that remains once the processor has run: decoding, and nothing else.

    decoder, prepared : of the network, or None where it has no part.
    """

    emulator: Emulator
    decoder: Decoder | None
    prepared: jax.Array | None
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
        """Offset (k, 3) and modes (t, 3 k) of all parts that are sums of modes.

        NumPy's: a JAX array first made inside somebody's ``jit`` would be that trace's for ever.
        """
        emulator, rows = self.emulator, self.nodes
        offset, modes = np.zeros((len(rows), 3)), [np.zeros((0, len(rows), 3))]
        if emulator.base != "nothing":
            offset = offset + np.asarray(emulator.series.displacement)[rows]
            modes.append(np.asarray(emulator.series.derivatives)[:, rows])
        if isinstance(self.decoder, SeparableDecoder):
            modes.append(np.asarray(self.prepared, dtype=float) * emulator.scale)
        if emulator.residual is not None:
            offset = offset + np.asarray(emulator.residual.offset)[rows]
            modes.append(np.asarray(emulator.residual.modes)[:, rows])
        both = np.concatenate(modes)
        return offset, both.reshape(len(both), 3 * len(rows))

    def coefficients(self, theta: jax.Array) -> jax.Array:
        """Of the linear parts' modes (t,) at ``theta`` (p,)."""
        emulator, position = self.emulator, self.scene.to_unit(theta)
        parts = [jnp.zeros(0)]
        if emulator.base != "nothing":
            parts.append(emulator.series.monomials(position))
        if isinstance(self.decoder, SeparableDecoder):
            branch = self.decoder.coefficients(emulator.normalise(theta))
            parts.append(branch.astype(jnp.float64))
        if emulator.residual is not None:
            parts.append(emulator.residual.coefficients(position))
        return jnp.concatenate(parts)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Displacement (..., k, 3) in mm at ``theta`` (..., p)."""
        offset, modes = self._linear
        coefficients = jnp.vectorize(self.coefficients, signature="(p)->(t)")(theta)
        free = offset + (coefficients @ modes).reshape(*theta.shape[:-1], *offset.shape)
        if isinstance(self.decoder, PointwiseDecoder) and self.prepared is not None:
            raw = self.decoder(self.prepared, self.emulator.normalise(theta))
            free = free + self.emulator.scale * raw.astype(jnp.float64)
        return self.emulator.hold(free, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Displacement and whether ``theta`` is inside the box the emulator was trained on."""
        return inside_only(self, theta)

    def at(self, nodes: np.ndarray) -> CachedEmulator:
        """The same map decoding only ``nodes``, which must be among those cached."""
        rows = rows_of(self, nodes)
        prepared = None if self.prepared is None else self.prepared[:, rows]
        return replace(self, prepared=prepared, nodes=self.nodes[rows])
