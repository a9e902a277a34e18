r"""The graph network as a part of an emulator: :math:`s\, \text{net}(x)`, in mm.

The network computes in float32, on positions scaled to standard deviation 1 and in units of
:math:`s`; its output is added to the other parts in float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.core.schema import read_as
from emulator.core.store import fill_tree, inside, named_leaves
from emulator.scenes.parameter_space import ParameterSpace
from emulator.scenes.scene import Scene
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import (
    Architecture,
    Decoder,
    build,
)
from emulator.surrogates.part import CachedPart, no_modes, widened

# Positions in the box are uniform on [0, 1]; this gives them standard deviation 1 (Eq. 25).
_TO_UNIT_SD = 12.0**0.5


@dataclass(frozen=True, eq=False)
class Standardisation:
    """The standardisation ``(theta - mean) / sd`` of the input of a network.

    space : the parameters.
    mean, sd : the mean and standard deviation of theta, (p,), in the parameters' units.
    """

    space: ParameterSpace
    mean: np.ndarray
    sd: np.ndarray

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return standardised theta (..., p) at positions (..., p) in the unit box."""
        return (self.space.from_unit(position) - self.mean) / self.sd


@dataclass(frozen=True, eq=False)
class Network:
    """A graph network with its graph and weights.

    Parameters
    ----------
    architecture : the sizes of the network.
    parameters : the number p of entries of theta.
    graph : the augmented graph of the scene's mesh.
    weights : the state of the network, an NNX ``State``.
    scale : the scale of the network's output by component, (3,) mm.
    basis : the modes given to a separable decoder, (f, n, 3) in units of ``scale``.
    standardisation : the standardisation of theta, for a network whose input is theta itself.
    """

    architecture: Architecture
    parameters: int
    graph: AugmentedGraph
    weights: nnx.State
    scale: np.ndarray
    basis: np.ndarray
    standardisation: Standardisation | None = None

    @cached_property
    def definition(self) -> nnx.GraphDef:
        """Structure of the network, without its weights."""
        network = _outline(self.architecture, self.graph, self.parameters, len(self.basis))
        return nnx.split(network)[0]

    def normalise(self, position: jax.Array) -> jax.Array:
        """Return the positions (..., p) in the unit box as the network takes them, float32."""
        if self.standardisation is not None:
            return self.standardisation(position).astype(jnp.float32)
        return standardised(position)

    def prepare(self, weights: nnx.State) -> tuple[Decoder, jax.Array]:
        """Return the decoder and its part that does not depend on theta, by one processor pass."""
        network = nnx.merge(self.definition, weights)
        states = network.processor(self.graph)
        return network.decoder, network.decoder.prepare(states, jnp.asarray(self.basis))

    def decode(self, decoder: Decoder, prepared: jax.Array, position: jax.Array) -> jax.Array:
        """Return the displacement (..., k, 3) mm at ``position`` (..., p), from :meth:`prepare`."""
        raw = decoder(prepared, self.normalise(position)).astype(jnp.float64)
        return raw * jnp.asarray(self.scale)

    def predict(self, weights: nnx.State, position: jax.Array) -> jax.Array:
        """Return the displacement (b, n, 3) mm at ``position`` (b, p), by one processor pass."""
        return self.decode(*self.prepare(weights), position)

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) mm at ``position`` (p,), processor included."""
        return self.predict(self.weights, position[None])[0]

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Run the processor and keep what decoding ``nodes`` (k,) needs."""
        # A decoder merged by itself holds no reference to the processor.
        decoder = nnx.merge(*nnx.split(nnx.merge(self.definition, self.weights).decoder))
        prepared = jax.jit(lambda: self.prepare(self.weights)[1])()[:, nodes]
        if not decoder.linear:
            return no_modes(nodes, Decoded(self, decoder, prepared))

        def coefficients(position: jax.Array) -> jax.Array:
            return decoder.coefficients(self.normalise(position)).astype(jnp.float64)

        modes = np.asarray(prepared, dtype=float) * self.scale
        return CachedPart(np.zeros((len(nodes), 3)), modes, coefficients)

    def arrays(self) -> dict[str, Any]:
        """Return the weights, graph, scale and basis by name."""
        tree = {
            "weights": nnx.to_pure_dict(self.weights),
            "graph": self.graph.arrays(),
            "scale": self.scale,
            "basis": self.basis,
        }
        if self.standardisation is not None:
            tree["theta"] = {"mean": self.standardisation.mean, "sd": self.standardisation.sd}
        return named_leaves(tree)

    def to_json(self) -> dict[str, Any]:
        """Return the architecture."""
        return {"architecture": asdict(self.architecture)}

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """Return the network with this description and these arrays."""
        architecture = read_as(Architecture, description["architecture"], "architecture")
        graph = AugmentedGraph(**inside(arrays, "graph"), real=len(scene.mesh.nodes))
        basis, parameters = arrays["basis"], len(scene.parameters)
        state = filled(architecture, graph, parameters, basis, inside(arrays, "weights"))
        theta = {name: widened(values) for name, values in inside(arrays, "theta").items()}
        standardisation = Standardisation(scene.space, **theta) if theta else None
        scale = widened(arrays["scale"])
        return cls(architecture, parameters, graph, state, scale, basis, standardisation)


def filled(
    architecture: Architecture,
    graph: AugmentedGraph,
    parameters: int,
    basis: np.ndarray,
    weights: Mapping[str, np.ndarray],
) -> nnx.State:
    """Return the network's state with ``weights`` by name; refuse one of another shape."""
    outline = _outline(architecture, graph, parameters, len(basis))
    return filled_state(outline, weights, "the emulator's network")


def filled_state(outline: nnx.Module, weights: Mapping[str, np.ndarray], what: str) -> nnx.State:
    """Return the state of the network of the shapes of ``outline``, with ``weights`` by name."""
    state = nnx.state(outline)
    pure = fill_tree(nnx.to_pure_dict(state), weights, what)
    nnx.replace_by_pure_dict(state, jax.tree.map(jnp.asarray, pure))
    return state


def standardised(position: jax.Array) -> jax.Array:
    """Return positions in the unit box with mean 0 and standard deviation 1, float32."""
    return ((position - 0.5) * _TO_UNIT_SD).astype(jnp.float32)


def fresh(
    scene: Scene,
    graph: AugmentedGraph,
    architecture: Architecture,
    scale: np.ndarray,
    seed: int,
    basis: np.ndarray | None = None,
) -> Network:
    """Return an untrained network, whose output is zero for every theta."""
    if basis is None:
        basis = np.zeros((0, *scene.held.shape), dtype=np.float32)
    count = len(scene.parameters)
    weights = nnx.state(build(architecture, graph, count, len(basis), seed))
    return Network(architecture, count, graph, weights, np.asarray(scale, dtype=float), basis)


@dataclass(frozen=True, eq=False)
class Decoded:
    """The field of a pointwise decoder over some nodes.

    network, decoder : the network and its decoder.
    prepared : the part of the decoder that does not depend on theta, (3, k, hidden).
    """

    network: Network
    decoder: Decoder
    prepared: jax.Array

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (..., k, 3) mm at ``position`` (..., p)."""
        return self.network.decode(self.decoder, self.prepared, position)

    def at(self, rows: np.ndarray) -> Decoded:
        """Return the field over rows of its nodes."""
        return replace(self, prepared=self.prepared[:, rows])


def _outline(architecture: Architecture, graph: AugmentedGraph, parameters: int, fixed: int) -> Any:
    """Return the network with shapes in place of weights."""
    return nnx.eval_shape(lambda: build(architecture, graph, parameters, fixed, 0))
