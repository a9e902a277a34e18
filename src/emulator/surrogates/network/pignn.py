r"""The physics-informed graph network, Algorithm 1 of Dalton et al. (2023).

Encode every node and edge; pass K rounds of messages

.. math::
    m_{ij} = \phi_e(e_{ij}, v_i, v_j), \quad m_{ji} = -m_{ij}, \qquad
    v_i \leftarrow v_i + \phi_v\Big(v_i, \sum_j m_{ij}\Big), \quad e_{ij} \leftarrow e_{ij} + m_{ij}

(equal and opposite, as forces are); take :math:`z_i = \text{LN}(v_i, \sum_j e_{ij})` of the mesh
nodes; and decode. The pointwise decoder, the paper's, applies to :math:`z_i` and an encoding of
theta one network for each displacement component. The separable decoder is
:math:`\sum_k c_k(\theta)\, \phi_k(z_i)`, with a branch network :math:`c` of theta and a trunk
network :math:`\phi` of the node, so that the modes :math:`\phi_k` can be kept and a displacement is
one matrix product. Encoders and messages do not depend on theta and are evaluated once a geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial, reduce
from itertools import pairwise
from typing import Literal, get_args, get_type_hints

import jax
import jax.numpy as jnp
from flax import nnx

from emulator.core.errors import InputError
from emulator.surrogates.network.graph import AugmentedGraph


@dataclass(frozen=True)
class Architecture:
    """Sizes of the network; the defaults are the paper's, about 510 000 weights.

    steps : the number K of message-passing steps.
    latent : the width M of node, edge and theta states.
    hidden : the widths of each network's hidden layers.
    decoder : ``pointwise``, Algorithm 1's, or ``separable``.
    modes : the number of learned modes of the separable decoder.
    edge_sum : the sum over a node's edges in its final state: ``antisymmetric``, Algorithm 1's, or
        over the edges it ``receives``, as the released code has it.
    trunk, branch : the widths of the hidden layers below the learned modes and below the
        coefficients of a separable decoder; ``hidden`` where empty.
    branch_activation : the function between the branch's layers; swish is smooth, CELU's second
        derivative, between all other layers, jumps.
    """

    steps: int = 5
    latent: int = 40
    hidden: tuple[int, ...] = (128, 128)
    decoder: Literal["pointwise", "separable"] = "pointwise"
    modes: int = 16
    edge_sum: Literal["antisymmetric", "receives"] = "antisymmetric"
    trunk: tuple[int, ...] = ()
    branch: tuple[int, ...] = ()
    branch_activation: Literal["celu", "swish"] = "celu"

    def __post_init__(self) -> None:
        for name in ("decoder", "edge_sum", "branch_activation"):
            kinds, value = get_args(get_type_hints(Architecture)[name]), getattr(self, name)
            if value not in kinds:
                raise InputError(f"{name} '{value}': use {' or '.join(kinds)}")


class MLP(nnx.Module):
    """Dense layers with an activation between them, on an input concatenated from several parts.

    The first layer is linear in each part, ``[a, b] @ W = a @ W_a + b @ W_b``, so a part that many
    rows share is multiplied once: :meth:`project` each part, add, then :meth:`finish`.

    Parameters
    ----------
    parts : the width of each part of the input.
    hidden : the widths of the hidden layers.
    out : the width of the output.
    layer_norm : whether to normalise the output (encoders and processor; not decoders).
    zero_last : whether the last layer starts at zero.
    activation : the name of the activation in ``jax.nn``.
    """

    def __init__(
        self,
        parts: tuple[int, ...],
        hidden: tuple[int, ...],
        out: int,
        *,
        layer_norm: bool = False,
        zero_last: bool = False,
        activation: str = "celu",
        rngs: nnx.Rngs,
    ) -> None:
        self.parts, self.activate = parts, getattr(jax.nn, activation)
        widths = (sum(parts), *hidden, out)
        linear = partial(nnx.Linear, param_dtype=jnp.float32, rngs=rngs)
        layers = [linear(a, b) for a, b in pairwise(widths)]
        if zero_last:
            layers[-1] = linear(widths[-2], out, kernel_init=nnx.initializers.zeros_init())
        self.layers = nnx.List(layers)
        self.norm = nnx.LayerNorm(out, param_dtype=jnp.float32, rngs=rngs) if layer_norm else None

    def project(self, part: int, values: jax.Array) -> jax.Array:
        """Return what part number ``part`` adds to the first layer, (..., hidden[0])."""
        start = sum(self.parts[:part])
        kernel = self.layers[0].kernel[start : start + self.parts[part]]
        return values.astype(kernel.dtype) @ kernel

    def finish(self, first: jax.Array) -> jax.Array:
        """Return the output (..., out) from the sum of all projections."""
        x = self._before(first, len(self.layers))
        return x if self.norm is None else self.norm(x)

    def hidden(self, *values: jax.Array) -> jax.Array:
        """Return the last hidden layer (..., hidden[-1]), from all parts."""
        return self.activate(self._before(self._first(values), len(self.layers) - 1))

    def _first(self, values: tuple[jax.Array, ...]) -> jax.Array:
        return reduce(jnp.add, (self.project(k, v) for k, v in enumerate(values)))

    def _before(self, first: jax.Array, stop: int) -> jax.Array:
        """Return the output of layer ``stop - 1`` from the sum of all projections."""
        bias = self.layers[0].bias
        x = first if bias is None else first + bias
        for layer in self.layers[1:stop]:
            x = layer(self.activate(x))
        return x

    def __call__(self, *values: jax.Array) -> jax.Array:
        """Return the output (..., out) from all parts."""
        return self.finish(self._first(values))


class MessagePassing(nnx.Module):
    """One round of messages along every edge."""

    def __init__(self, architecture: Architecture, rngs: nnx.Rngs) -> None:
        M, hidden = architecture.latent, architecture.hidden
        self.edge = MLP((M, M, M), hidden, M, layer_norm=True, rngs=rngs)
        self.node = MLP((M, M), hidden, M, layer_norm=True, rngs=rngs)

    def __call__(
        self, nodes: jax.Array, edges: jax.Array, graph: AugmentedGraph
    ) -> tuple[jax.Array, jax.Array]:
        """Return the updated node (N, M) and edge (E, M) states."""
        first = (
            self.edge.project(0, edges)
            + self.edge.project(1, nodes)[graph.receivers]
            + self.edge.project(2, nodes)[graph.senders]
        )
        messages = self.edge.finish(first)
        nodes = nodes + self.node(nodes, antisymmetric_sum(messages, graph))
        return nodes, edges + messages


def received_sum(messages: jax.Array, graph: AugmentedGraph) -> jax.Array:
    """Return the sum (N, M) at each node of the messages (E, M) that it receives."""
    zero = jnp.zeros((len(graph.node_features), messages.shape[1]), messages.dtype)
    return zero.at[graph.receivers].add(messages)


def antisymmetric_sum(messages: jax.Array, graph: AugmentedGraph) -> jax.Array:
    """Return :func:`received_sum`, with opposite sign at the sender."""
    return received_sum(messages, graph).at[graph.senders].add(-messages)


class Processor(nnx.Module):
    """Geometry to the state of each mesh node, for all theta alike."""

    def __init__(
        self, architecture: Architecture, node_width: int, edge_width: int, rngs: nnx.Rngs
    ) -> None:
        M, hidden = architecture.latent, architecture.hidden
        self.encode_node = MLP((node_width,), hidden, M, layer_norm=True, rngs=rngs)
        self.encode_edge = MLP((edge_width,), hidden, M, layer_norm=True, rngs=rngs)
        self.rounds = nnx.List(
            [MessagePassing(architecture, rngs) for _ in range(architecture.steps)]
        )
        self.norm = nnx.LayerNorm(2 * M, param_dtype=jnp.float32, rngs=rngs)
        self.edge_sum = architecture.edge_sum

    def __call__(self, graph: AugmentedGraph) -> jax.Array:
        """Return the states (n, 2M) of the mesh nodes."""
        nodes = self.encode_node(jnp.asarray(graph.node_features))
        edges = self.encode_edge(jnp.asarray(graph.edge_features))
        for one_round in self.rounds:
            structure, weights = nnx.split(one_round)
            # Computed again backward: 26.5 ms on the beam; storing its 79 MB takes 38.8.
            nodes, edges = jax.checkpoint(
                lambda w, v, e, structure=structure: nnx.merge(structure, w)(v, e, graph)
            )(weights, nodes, edges)
        summed = antisymmetric_sum if self.edge_sum == "antisymmetric" else received_sum
        state = jnp.concatenate([nodes, summed(edges, graph)], axis=1)
        return self.norm(state[: graph.real])


class PointwiseDecoder(nnx.Module):
    """Node states and theta to displacement, one network a component (Algorithm 1)."""

    linear = False  # its output is not a sum of modes

    def __init__(self, architecture: Architecture, parameters: int, rngs: nnx.Rngs) -> None:
        M, hidden = architecture.latent, architecture.hidden
        self.encode_theta = MLP((parameters,), hidden, M, layer_norm=True, rngs=rngs)
        component = partial(MLP, (M, 2 * M), hidden, 1, zero_last=True, rngs=rngs)
        self.components = nnx.List([component() for _ in range(3)])

    def prepare(self, states: jax.Array) -> jax.Array:
        """Return what the states add to the first layer of each component, (3, n, hidden[0])."""
        return jnp.stack([component.project(1, states) for component in self.components])

    def __call__(self, prepared: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the output (..., n, 3) for normalised ``theta`` (..., p), from :meth:`prepare`."""
        encoded = self.encode_theta(theta)
        parts = [
            component.finish(component.project(0, encoded)[..., None, :] + prepared[k])
            for k, component in enumerate(self.components)
        ]
        return jnp.concatenate(parts, axis=-1)


def branch(parts: tuple[int, ...], out: int, architecture: Architecture, rngs: nnx.Rngs) -> MLP:
    """Return the network of the coefficients, zero before training."""
    widths = architecture.branch or architecture.hidden
    kind = architecture.branch_activation
    return MLP(parts, widths, out, zero_last=True, activation=kind, rngs=rngs)


def trunk(
    vectors: int, architecture: Architecture, rngs: nnx.Rngs, parts: tuple[int, ...] = ()
) -> MLP:
    """Return the network of the modes: from a node's state, ``vectors`` numbers for each mode.

    parts : the widths of its inputs, where it has others than the state.
    """
    widths, out = architecture.trunk or architecture.hidden, vectors * architecture.modes
    return MLP(parts or (2 * architecture.latent,), widths, out, rngs=rngs)


class SeparableDecoder(nnx.Module):
    """A sum of modes: coefficients of theta times modes of the node.

    branch : normalised theta (..., p) to the coefficients (..., r).
    trunk : a node's state to its modes, linear combinations of ``trunk.hidden``.
    """

    linear = True

    def __init__(self, architecture: Architecture, parameters: int, rngs: nnx.Rngs) -> None:
        self.branch = branch((parameters,), architecture.modes, architecture, rngs)
        self.trunk = trunk(3, architecture, rngs)

    def prepare(self, states: jax.Array) -> jax.Array:
        """Return the modes (r, n, 3)."""
        return jnp.moveaxis(self.trunk(states).reshape(len(states), 3, -1), -1, 0)

    def __call__(self, prepared: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the output (..., n, 3) for normalised ``theta`` (..., p), from :meth:`prepare`."""
        return jnp.tensordot(self.branch(theta), prepared, axes=1)


Decoder = PointwiseDecoder | SeparableDecoder


class PIGNN(nnx.Module):
    """Processor and decoder of one scene, with weights from a seed; of ``graph`` widths matter."""

    def __init__(
        self,
        architecture: Architecture,
        graph: AugmentedGraph,
        parameters: int,
        seed: int,
    ) -> None:
        rngs = nnx.Rngs(seed)
        widths = graph.node_features.shape[1], graph.edge_features.shape[1]
        self.processor = Processor(architecture, *widths, rngs)
        self.decoder: Decoder = (
            PointwiseDecoder(architecture, parameters, rngs)
            if architecture.decoder == "pointwise"
            else SeparableDecoder(architecture, parameters, rngs)
        )
