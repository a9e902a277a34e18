r"""A network that has learned a family of ventricles, as a part of an emulator.

.. math:: u(x) = r(p) \sum_v \Big[ s \sum_k c_k(x, g)\, \varphi_{kv}(z_i, y_i) \Big] V_{iv}

with :math:`V_{iv}` the vectors of node i, mm, that turn with the body, its linear responses to
pressure among them (:mod:`emulator.surrogates.network.body`), :math:`y_i` its own features,
:math:`z_i` the state there after the messages, and :math:`g` the numbers of the whole body with a
short summary of the states' mean over the wall. The displacement is zero without pressure:
:math:`r = (1 + p_0)\, p / (p + p_0)` of the pressure's position p in the box. The messages know no
theta, so that on a body the part is a sum of modes like any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
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
from emulator.surrogates.network.body import VECTORS, BodyFeatures, describe
from emulator.surrogates.network.graph import AugmentedGraph
from emulator.surrogates.network.pignn import Architecture, Processor, branch, trunk
from emulator.surrogates.part import CachedPart, widened

_SLACK = 1e-9  # round-off allowed, as a fraction of a parameter's range
_BEYOND = 0.1  # allowed excess of a body over the family's range, as a fraction of it
_SUMMARY = 16  # numbers of a body that the network finds itself
_HALF = 0.2  # the position p_0 of the pressure at which r is (1 + p_0) / 2


class Widths(NamedTuple):
    """The numbers of features of regions, edges, nodes and bodies, and of entries of theta."""

    region: int
    edge: int
    local: int
    numbers: int
    theta: int


class Inputs(NamedTuple):
    """A body as the network takes it, its features standardised.

    graph : the graph of the regions.
    local : the features of all nodes, (n, d).
    near, closeness : the regions around each node and their weights, (n, k).
    vectors : the vectors of each node, (n, v, 3) mm. shares : of the wall in each region, (c,).
    numbers : the numbers of the whole body, (b,).
    """

    graph: AugmentedGraph
    local: Any
    near: Any
    closeness: Any
    vectors: Any
    shares: Any
    numbers: Any


class FamilyModule(nnx.Module):
    """Processor, trunk and branch, with weights from a seed.

    branch : normalised theta (..., p), a body's numbers (b,) and its summary to the coefficients
        (..., r).
    """

    def __init__(self, architecture: Architecture, widths: Widths, seed: int) -> None:
        rngs = nnx.Rngs(seed)
        states = 2 * architecture.latent
        self.processor = Processor(architecture, widths.region, widths.edge, rngs)
        self.summary = nnx.Linear(states, _SUMMARY, param_dtype=jnp.float32, rngs=rngs)
        parts = (widths.theta, widths.numbers, _SUMMARY)
        self.branch = branch(parts, architecture.modes, architecture, rngs)
        self.trunk = trunk(VECTORS, architecture, rngs, (states, widths.local))

    def prepare(self, body: Inputs) -> tuple[jax.Array, jax.Array]:
        """Return the modes (r, n, 3) in units of the body's vectors, and its summary."""
        states = self.processor(body.graph)
        weights = jnp.asarray(body.closeness, states.dtype)
        at_nodes = jnp.einsum("nk,nks->ns", weights, states[body.near])
        parts = self.trunk(at_nodes, jnp.asarray(body.local)).reshape(len(at_nodes), VECTORS, -1)
        modes = jnp.einsum("nvk,nvi->kni", parts, jnp.asarray(body.vectors, parts.dtype))
        mean = jnp.asarray(body.shares, states.dtype) @ states
        return modes, jnp.tanh(self.summary(mean))

    def coefficients(
        self, position: jax.Array, numbers: jax.Array, summary: jax.Array, pressure: int
    ) -> jax.Array:
        """Return the coefficients (..., r) at ``position`` (..., p) in the box of the training.

        pressure : which entry of theta the pressure is.
        """
        x = position[..., pressure, None].astype(jnp.float32)
        values = self.branch(standardised(position), jnp.asarray(numbers), summary)
        return (1.0 + _HALF) * x / (x + _HALF) * values


class Standard(NamedTuple):
    """Means and standard deviations over a family: regions', edges', nodes' and bodies' features.

    Each is (2, d): the means, then the deviations.
    """

    region: np.ndarray
    edge: np.ndarray
    local: np.ndarray
    numbers: np.ndarray

    def of(self, body: BodyFeatures) -> Inputs:
        """Return ``body`` with its features standardised, rounded as in a file."""
        graph = body.graph
        return Inputs(
            graph=AugmentedGraph(
                node_features=_scaled(graph.node_features, self.region),
                edge_features=_scaled(graph.edge_features, self.edge),
                senders=graph.senders.astype(np.int32),
                receivers=graph.receivers.astype(np.int32),
                real=graph.real,
            ),
            local=_scaled(body.local, self.local),
            near=body.near.astype(np.int32),
            closeness=body.closeness.astype(np.float32),
            vectors=body.vectors.astype(np.float32),
            shares=body.shares.astype(np.float32),
            numbers=_scaled(np.array(list(body.numbers.values())), self.numbers),
        )


def _scaled(values: np.ndarray, moments: np.ndarray) -> np.ndarray:
    return ((values - moments[0]) / moments[1]).astype(np.float32)


class FamilyEnsemble(NamedTuple):
    """Networks that have learned a family of bodies, from unlike weights; on no body.

    architecture : the sizes of :class:`FamilyModule`.
    members : the weights of each network; their mean is what is predicted.
    standard : the means and deviations of the features.
    scale : the scale s of displacements over the body's size.
    parameters : the entries of theta, and the box from which they were drawn.
    pressure : the name of the pressure among them; the lower end of its range is zero.
    physics : the law, constants and loads that the network has learned.
    shapes : the range of each number of ``BodyFeatures.shape`` over the family.
    """

    architecture: Architecture
    members: tuple[nnx.State, ...]
    standard: Standard
    scale: float
    parameters: tuple[Parameter, ...]
    pressure: str
    physics: Mapping[str, Any]
    shapes: Mapping[str, tuple[float, float]]

    @property
    def widths(self) -> Widths:
        """The widths of the network's inputs."""
        region, edge, local, numbers = (moments.shape[1] for moments in self.standard)
        return Widths(region, edge, local, numbers, len(self.parameters))

    @property
    def outline(self) -> FamilyModule:
        """The network with shapes in place of weights."""
        return nnx.eval_shape(lambda: FamilyModule(self.architecture, self.widths, 0))

    @property
    def space(self) -> ParameterSpace:
        """The box of the training."""
        return ParameterSpace(self.parameters)


@dataclass(frozen=True, eq=False)
class FamilyNetwork:
    """A network that has learned a family of bodies, on one body.

    learned : the network.
    scene : the scene, its theta within the box of the training.
    """

    learned: FamilyEnsemble
    scene: Scene

    @cached_property
    def features(self) -> BodyFeatures:
        """The features of the body."""
        with jax.ensure_compile_time_eval():  # the first call may be inside a trace
            return describe(self.scene)

    @cached_property
    def body(self) -> Inputs:
        """The body as this network takes it."""
        return self.learned.standard.of(self.features)

    @cached_property
    def _definition(self) -> nnx.GraphDef:
        return nnx.split(self.learned.outline)[0]

    def _modules(self) -> list[FamilyModule]:
        return [nnx.merge(self._definition, weights) for weights in self.learned.members]

    def _prepare(self) -> tuple[jax.Array, list[jax.Array]]:
        """Return all members' modes (r, n, 3) mm and their summaries, from one pass of each."""
        modes, summaries = zip(*(m.prepare(self.body) for m in self._modules()), strict=True)
        share = self.learned.scale / len(modes)
        return share * jnp.concatenate(modes), list(summaries)

    def _coefficients(
        self, modules: list[FamilyModule], position: jax.Array, summaries: list[jax.Array]
    ) -> jax.Array:
        """Return the coefficients (r,) of all members at ``position`` (p,) in the scene's box."""
        trained = self.learned.space
        values = self.scene.resolve(self.scene.from_unit(position))
        inside_box = trained.to_unit(jnp.stack([jnp.asarray(values[n]) for n in trained.names]))
        which = trained.names.index(self.learned.pressure)
        numbers = self.body.numbers
        return jnp.concatenate(
            [
                module.coefficients(inside_box, numbers, summary, which)
                for module, summary in zip(modules, summaries, strict=True)
            ]
        )

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (n, 3) mm at ``position`` (p,), processor included."""
        modes, summaries = self._prepare()
        coefficients = self._coefficients(self._modules(), position, summaries)
        return jnp.tensordot(coefficients, modes, axes=1).astype(jnp.float64)

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Run the processor and keep the modes at ``nodes`` (k,)."""
        modes, summaries = jax.jit(self._prepare)()
        node_modes = np.asarray(modes, dtype=float)[:, nodes]
        modules = self._modules()

        def coefficients(position: jax.Array) -> jax.Array:
            return self._coefficients(modules, position, summaries).astype(jnp.float64)

        return CachedPart(np.zeros((len(nodes), 3)), node_modes, coefficients)

    def arrays(self) -> dict[str, Any]:
        """Return the weights and the features' standard by name; the body is described anew."""
        learned = self.learned
        return named_leaves(
            {
                "members": {
                    str(k): nnx.to_pure_dict(member) for k, member in enumerate(learned.members)
                },
                "standard": learned.standard._asdict(),
            }
        )

    def to_json(self) -> dict[str, Any]:
        """Return the architecture, scale, box of theta, physics and shapes."""
        learned = self.learned
        return {
            "architecture": asdict(learned.architecture),
            "scale": learned.scale,
            "parameters": [parameter.to_json() for parameter in learned.parameters],
            "pressure": learned.pressure,
            "physics": learned.physics,
            "shapes": learned.shapes,
        }

    @classmethod
    def restore(
        cls, scene: Scene, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> Self:
        """Return the network with this description and these arrays, on the body of ``scene``."""
        learned = FamilyEnsemble(
            architecture=read_as(Architecture, description["architecture"], "architecture"),
            members=(),
            standard=Standard(**{n: widened(a) for n, a in inside(arrays, "standard").items()}),
            scale=float(description["scale"]),
            parameters=tuple(Parameter(**entry) for entry in description["parameters"]),
            pressure=description["pressure"],
            physics=description["physics"],
            shapes={name: (low, high) for name, (low, high) in description["shapes"].items()},
        )
        members: list[nnx.State] = []
        while weights := inside(arrays, f"members/{len(members)}"):
            members.append(filled_state(learned.outline, weights, "the family's network"))
        return cls(learned._replace(members=tuple(members)), scene)

    def on(self, scene: Scene) -> Self:
        """Return the network on another ventricle, which must resemble the family.

        Raises
        ------
        InputError
            Another law, constant, load or order of elements, a theta outside the box of the
            training, no fibres, or a body unlike the family's.
        """
        _check_physics(self.learned, scene)
        other = replace(self, scene=scene)
        _check_shape(self.learned, scene, other.features.shape)
        return other


def physics_of(scene: Scene, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    """Return the physics that a network is bound to: law, kinds of loads, springs, constants."""
    names = {parameter.name for parameter in parameters}
    description = scene.identity.description
    constants = {n: v for n, v in description["constants"].items() if n not in names}
    return {
        "law": description["law"],
        "constants": constants,
        "loads": sorted(load.kind for load in scene.loads),
        "springs": description["springs"],
        "dilatation": description["dilatation"],
        "loaded_by": description.get("loaded_by"),
        "regions": scene.regions is not None or scene.stiffness_modes is not None,
        "order of elements": scene.mesh.order,
    }


def _check_physics(learned: FamilyEnsemble, scene: Scene) -> None:
    """Raise :class:`InputError` for other physics, or a range of theta outside the training's."""
    trained = {parameter.name: parameter for parameter in learned.parameters}
    ranges = {name: (value, value, "") for name, value in scene.constants.items()}
    ranges |= {p.name: (p.low, p.high, p.unit) for p in scene.parameters}
    known, varied = set(trained), {parameter.name for parameter in scene.parameters}
    if not varied <= known or not known <= set(ranges):
        raise InputError(
            f"scene '{scene.name}': its theta is {', '.join(sorted(varied))}; the network was "
            f"trained with {', '.join(sorted(known))}, some of which may be constants"
        )
    ours = physics_of(scene, learned.parameters)
    for name, theirs in learned.physics.items():
        if ours[name] != theirs:
            raise InputError(
                f"scene '{scene.name}': {name}: {ours[name]}; the network was trained with {theirs}"
            )
    for name, box in trained.items():
        low, high, unit = ranges[name]
        slack = _SLACK * (box.high - box.low)
        if low < box.low - slack or high > box.high + slack:
            raise InputError(
                f"scene '{scene.name}': {name} ranges from {low:g} to {high:g} {unit}; the "
                f"network knows {box.low:g} to {box.high:g}"
            )


def _check_shape(learned: FamilyEnsemble, scene: Scene, shape: Mapping[str, float]) -> None:
    """Refuse a body further outside the family than a tenth of its range."""
    for name, (low, high) in learned.shapes.items():
        slack = _BEYOND * (high - low)
        if not low - slack <= shape[name] <= high + slack:
            unit, hint = (" mm", "; are its coordinates in mm?") if name == "size" else ("", "")
            raise InputError(
                f"scene '{scene.name}' is unlike the ventricles the network has seen: its {name} "
                f"is {shape[name]:.3g}{unit}, theirs {low:.3g} to {high:.3g}{hint}"
            )
