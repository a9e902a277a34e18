r"""The graph network as a part of an emulator: :math:`s\, \text{net}(x)`, in mm.

The network computes in float32, on positions scaled to standard deviation 1 and in units of
:math:`s`; its output is added to the other parts in float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
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
from emulator.surrogates.network.pignn import PIGNN, Architecture, Decoder
from emulator.surrogates.part import CachedPart, widened

# Positions in the box are uniform on [0, 1]; this gives them standard deviation 1 (Eq. 25).
_TO_UNIT_SD = 12.0**0.5


@dataclass(frozen=True, eq=False)
class Network:
    """A graph network with its graph and weights.

    Parameters
    ----------
    architecture : the sizes of the network.
    space : the entries of theta.
    graph : the augmented graph of the scene's mesh.
    scale : the scale of the network's output by component, (3,) mm.
    theta : ``mean`` and ``sd`` of theta, each (p,) in the parameters' units, for a network whose
        input is standardised theta itself; empty for one that takes positions.
    weights : the state of the network, an NNX ``State``.
    """

    architecture: Architecture
    space: ParameterSpace
    graph: AugmentedGraph
    scale: np.ndarray
    theta: Mapping[str, np.ndarray] = field(default_factory=dict)
    weights: nnx.State = field(default_factory=lambda: nnx.State({}))

    def filled(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return the network with ``weights`` by name; refuse one of another shape."""
        return replace(self, weights=filled_state(self.outline, weights, "the emulator's network"))

    @property
    def outline(self) -> PIGNN:
        """The network with shapes in place of weights."""
        return nnx.eval_shape(lambda: PIGNN(self.architecture, self.graph, len(self.space), 0))

    @cached_property
    def definition(self) -> nnx.GraphDef:
        """Structure of the network, without its weights."""
        return nnx.split(self.outline)[0]

    def normalise(self, position: jax.Array) -> jax.Array:
        """Return the positions (..., p) in the unit box as the network takes them, float32."""
        if not self.theta:
            return standardised(position)
        theta = self.space.from_unit(position)
        return ((theta - self.theta["mean"]) / self.theta["sd"]).astype(jnp.float32)

    def prepare(self, weights: nnx.State) -> tuple[Decoder, jax.Array]:
        """Return the decoder and its part that does not depend on theta, by one processor pass."""
        network = nnx.merge(self.definition, weights)
        states = network.processor(self.graph)
        return network.decoder, network.decoder.prepare(states)

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
        offset = np.zeros((len(nodes), 3))
        if not decoder.linear:
            nothing = np.zeros((0, *offset.shape)), lambda _: jnp.zeros(0)
            return CachedPart(offset, *nothing, prepared, partial(self.decode, decoder))

        def coefficients(position: jax.Array) -> jax.Array:
            return decoder.branch(self.normalise(position)).astype(jnp.float64)

        return CachedPart(offset, np.asarray(prepared, dtype=float) * self.scale, coefficients)

    def arrays(self) -> dict[str, Any]:
        """Return the weights, graph, scale, and moments of theta by name."""
        return named_leaves(
            {
                "weights": nnx.to_pure_dict(self.weights),
                "graph": self.graph.arrays(),
                "scale": self.scale,
                "theta": dict(self.theta),
            }
        )

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
        theta = {name: widened(values) for name, values in inside(arrays, "theta").items()}
        empty = cls(architecture, scene.space, graph, widened(arrays["scale"]), theta)
        return empty.filled(inside(arrays, "weights"))


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
) -> Network:
    """Return an untrained network, whose output is zero for every theta."""
    weights = nnx.state(PIGNN(architecture, graph, len(scene.space), seed))
    scale = np.asarray(scale, dtype=float)
    return Network(architecture, scene.space, graph, scale, weights=weights)
