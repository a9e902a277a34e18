r"""A network that has learned a family of ventricles, as a part of an emulator.

.. math:: u(x) = \sum_v \Big[ s \sum_k c_k(x, g)\, \varphi_{kv}(z_i) \Big] V_{iv}

with :math:`V_{iv}` the vectors of node i, mm, that turn with the body
(:mod:`emulator.surrogates.network.graph`), :math:`z_i` its state after the messages, and
:math:`g` the states' mean over the wall, so that coefficients depend on the whole body. The
messages know no theta, so that on a body the part is a sum of modes like any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from emulator.core.errors import InputError
from emulator.core.schema import read_as
from emulator.core.store import inside, named_leaves
from emulator.scenes.parameter_space import Parameter, ParameterSpace
from emulator.scenes.scene import Scene
from emulator.surrogates.network import filled_state, standardised
from emulator.surrogates.network.graph import AugmentedGraph, describe
from emulator.surrogates.network.pignn import Architecture, Processor, branch, trunk
from emulator.surrogates.part import CachedPart

_SLACK = 1e-9  # round-off allowed, as a fraction of a parameter's range
_BEYOND = 0.1  # allowed excess of a body over the family's range, as a fraction of it

VECTORS = 7
"""The number of vectors of a node of which the output is a combination."""


class FamilyModule(nnx.Module):
    """Processor, trunk and branch, with weights from a seed.

    widths : the numbers of features of a node and an edge, and of entries p of theta.
    branch : normalised theta (..., p) and a body's mean state (2M,) to the coefficients (..., r).
    """

    def __init__(self, architecture: Architecture, widths: tuple[int, int, int], seed: int) -> None:
        rngs = nnx.Rngs(seed)
        self.processor = Processor(architecture, *widths[:2], rngs)
        parts = (widths[2], 2 * architecture.latent)
        self.branch = branch(parts, architecture.modes, architecture, rngs)
        self.trunk = trunk(VECTORS, architecture, rngs)

    def prepare(
        self, graph: AugmentedGraph, vectors: jax.Array, shares: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the modes (r, n, 3) in units of ``vectors`` (n, 7, 3), and the mean state (2M,).

        shares : the share of the wall's volume at each node, (n,).
        """
        states = self.processor(graph)
        weights = self.trunk(states).reshape(len(states), -1, VECTORS)
        modes = jnp.einsum("nkv,nvi->kni", weights, vectors.astype(weights.dtype))
        return modes, shares.astype(states.dtype) @ states


class Standard(NamedTuple):
    """The means and standard deviations of the features over a family, each (d,) or (4,)."""

    node_mean: np.ndarray
    node_sd: np.ndarray
    edge_mean: np.ndarray
    edge_sd: np.ndarray

    def of(self, graph: AugmentedGraph) -> AugmentedGraph:
        """Return ``graph`` with its features standardised."""
        nodes = (graph.node_features - self.node_mean) / self.node_sd
        edges = (graph.edge_features - self.edge_mean) / self.edge_sd
        return AugmentedGraph(
            node_features=nodes.astype(np.float32),
            edge_features=edges.astype(np.float32),
            senders=graph.senders.astype(np.int32),
            receivers=graph.receivers.astype(np.int32),
            real=graph.real,
        )


class Learned(NamedTuple):
    """A network that has learned a family of bodies, on no body.

    architecture, weights : the sizes and the weights of :class:`FamilyModule`.
    standard : the means and deviations of the features.
    scale : the scale s of displacements over the body's size.
    parameters : the entries of theta, and the box from which they were drawn.
    physics : the law, constants and loads that the network has learned.
    shapes : the range of each number of ``BodyFeatures.shape`` over the family.
    """

    architecture: Architecture
    weights: nnx.State
    standard: Standard
    scale: float
    parameters: tuple[Parameter, ...]
    physics: Mapping[str, Any]
    shapes: Mapping[str, tuple[float, float]]

    @property
    def widths(self) -> tuple[int, int, int]:
        """Features of a node and an edge, entries of theta."""
        standard = self.standard
        return len(standard.node_mean), len(standard.edge_mean), len(self.parameters)

    @property
    def outline(self) -> FamilyModule:
        """The network with shapes in place of weights."""
        return nnx.eval_shape(lambda: FamilyModule(self.architecture, self.widths, 0))


@dataclass(frozen=True, eq=False)
class FamilyNetwork:
    """A network that has learned a family of bodies, on one body.

    learned : the network.
    space : the parameters of the scene, within the box of the training.
    graph : the graph of the body.
    vectors : the vectors of each node, (n, 7, 3) mm.
    shares : the part of the wall's volume at each node, (n,).
    """

    learned: Learned
    space: ParameterSpace
    graph: AugmentedGraph
    vectors: np.ndarray
    shares: np.ndarray

    @cached_property
    def _definition(self) -> nnx.GraphDef:
        return nnx.split(self.learned.outline)[0]

    def _module(self) -> FamilyModule:
        return nnx.merge(self._definition, self.learned.weights)

    def _prepare(self) -> tuple[jax.Array, jax.Array]:
        """Return the modes (r, n, 3) mm and the mean state, from one processor pass."""
        modes, mean = self._module().prepare(
            self.graph, jnp.asarray(self.vectors), jnp.asarray(self.shares)
        )
        return self.learned.scale * modes, mean

    def normalise(self, position: jax.Array) -> jax.Array:
        """Return the positions (..., p) in the scene's box as the network takes them, float32."""
        trained = ParameterSpace(self.learned.parameters)
        if self.space != trained:
            order = np.array([self.space.names.index(name) for name in trained.names])
            position = trained.to_unit(self.space.from_unit(position)[..., order])
        return standardised(position)

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) mm at ``position`` (p,), processor included."""
        modes, mean = self._prepare()
        coefficients = self._module().branch(self.normalise(position), mean)
        return jnp.tensordot(coefficients, modes, axes=1).astype(jnp.float64)

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Run the processor and keep the modes at ``nodes`` (k,)."""
        modes, mean = jax.jit(self._prepare)()
        node_modes = np.asarray(modes, dtype=float)[:, nodes]
        network = nnx.merge(*nnx.split(self._module().branch))

        def coefficients(position: jax.Array) -> jax.Array:
            return network(self.normalise(position), mean).astype(jnp.float64)

        return CachedPart(np.zeros((len(nodes), 3)), node_modes, coefficients)

    def arrays(self) -> dict[str, Any]:
        """Return the weights, features and their standard, vectors and shares by name."""
        return named_leaves(
            {
                "weights": nnx.to_pure_dict(self.learned.weights),
                "standard": self.learned.standard._asdict(),
                "graph": self.graph.arrays(),
                "vectors": self.vectors.astype(np.float32),
                "shares": self.shares.astype(np.float32),
            }
        )

    def to_json(self) -> dict[str, Any]:
        """Return the architecture, scale, box of theta, physics and shapes."""
        learned = self.learned
        return {
            "architecture": asdict(learned.architecture),
            "scale": learned.scale,
            "parameters": [parameter.to_json() for parameter in learned.parameters],
            "physics": dict(learned.physics),
            "shapes": {name: list(ends) for name, ends in learned.shapes.items()},
        }

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """Return the part with this description and these arrays."""
        learned = Learned(
            architecture=read_as(Architecture, description["architecture"], "architecture"),
            weights=nnx.State({}),
            standard=Standard(**inside(arrays, "standard")),
            scale=float(description["scale"]),
            parameters=tuple(Parameter(**each) for each in description["parameters"]),
            physics=description["physics"],
            shapes={name: (low, high) for name, (low, high) in description["shapes"].items()},
        )
        weights = filled_state(learned.outline, inside(arrays, "weights"), "the family's network")
        learned = learned._replace(weights=weights)
        graph = AugmentedGraph(**inside(arrays, "graph"), real=len(scene.mesh.nodes))
        return cls(learned, scene.space, graph, arrays["vectors"], arrays["shares"])


def on_body(learned: Learned, scene: Scene, *, strict: bool = True) -> FamilyNetwork:
    """Return the network for ``scene``, whose body must resemble the family.

    strict : whether to refuse a body outside the shapes of the family.

    Raises
    ------
    InputError
        Another law, constant or kind of load, a theta outside the box of the training, no fibres,
        or a body unlike the family's.
    """
    _check_physics(learned, scene)
    body = describe(scene)
    if strict:
        _check_shape(learned, scene, body.shape)
    graph = learned.standard.of(body.graph)
    # Rounded as in a file, so that a reloaded emulator makes equal predictions.
    vectors, shares = body.vectors.astype(np.float32), body.shares.astype(np.float32)
    return FamilyNetwork(learned, scene.space, graph, vectors, shares)


def physics_of(scene: Scene) -> dict[str, Any]:
    """Return the law, constants, and kinds of loads, of which a network knows one set."""
    loads = sorted(load.kind for load in scene.loads)
    regions = scene.regions is not None
    return {**scene.identity.description, "loads": loads, "regions": regions}


def _check_physics(learned: Learned, scene: Scene) -> None:
    """Refuse a scene of other physics, or of a theta that no training reached."""
    ours = physics_of(scene)
    for name, theirs in learned.physics.items():
        if ours[name] != theirs:
            raise InputError(
                f"scene '{scene.name}': its {name} are {ours[name]}, and the network was trained "
                f"with {theirs}"
            )
    trained = {parameter.name: parameter for parameter in learned.parameters}
    for parameter in scene.parameters:
        box = trained[parameter.name]
        slack = _SLACK * (box.high - box.low)
        if parameter.low < box.low - slack or parameter.high > box.high + slack:
            raise InputError(
                f"scene '{scene.name}': {parameter.name} ranges from {parameter.low:g} to "
                f"{parameter.high:g} {parameter.unit}; the network knows {box.low:g} to "
                f"{box.high:g}"
            )


def _check_shape(learned: Learned, scene: Scene, shape: Mapping[str, float]) -> None:
    """Refuse a body further outside the family than a tenth of its range."""
    for name, (low, high) in learned.shapes.items():
        slack = _BEYOND * (high - low)
        if not low - slack <= shape[name] <= high + slack:
            unit, hint = (" mm", "; are its coordinates in mm?") if name == "size" else ("", "")
            raise InputError(
                f"scene '{scene.name}' is unlike the ventricles the network has seen: its {name} "
                f"is {shape[name]:.3g}{unit}, theirs {low:.3g} to {high:.3g}{hint}"
            )
