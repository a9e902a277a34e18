"""Observation operators: what of a displacement field was measured.

Each stands for one kind of measurement; :class:`Observations` holds those made at once, by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.geometry.cavity import Cavity
from emulator.scenes.cavities import find_cavity
from emulator.scenes.scene import Scene
from emulator.surrogates.protocol import all_nodes, check_nodes

# How far outside the body a point may lie, as a fraction of the body's size.
_SLACK = 1e-3

SEVERAL = "several"


class Observation(Protocol):
    """A function of the displacement of a few nodes.

    quantity : what is measured, ``displacement`` or ``volume``; its name where it is alone.
    unit : of the data.
    """

    quantity: str
    unit: str

    @property
    def nodes(self) -> np.ndarray:
        """Nodes a forward map must return, (k,)."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the data: (d, 3) for displacements of d points, () for a volume."""
        ...

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Data without noise (..., *shape) from the displacement of ``nodes`` (..., k, 3) mm."""
        ...

    def describe(self) -> dict[str, Any]:
        """Plain JSON from which :func:`observation_from` makes it again."""
        ...


@dataclass(frozen=True, eq=False)
class NodalDisplacements:
    """Displacements of some nodes ``nodes`` (d,), at rest at ``points`` (d, 3), in mm."""

    nodes: np.ndarray
    points: np.ndarray

    quantity = "displacement"
    unit = "mm"

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, 3)."""
        return self.points.shape

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """The displacements themselves."""
        return displacement

    def describe(self) -> dict[str, Any]:
        """Kind and node indices."""
        return {"kind": "nodes", "nodes": self.nodes.tolist()}


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Displacements of material points between nodes, by linear interpolation in their element.

    points : (d, 3) mm, where in the reference body they are.
    corners : (d, 4) positions in ``nodes`` of each point's element.
    weights : (d, 4) barycentric coordinates.
    """

    nodes: np.ndarray
    points: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    quantity = "displacement"
    unit = "mm"

    @property
    def shape(self) -> tuple[int, ...]:
        """(d, 3)."""
        return self.points.shape

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Interpolated displacements (..., d, 3)."""
        corner_values = displacement[..., self.corners, :]
        return jnp.sum(corner_values * self.weights[:, :, None], axis=-2)

    def describe(self) -> dict[str, Any]:
        """Kind and reference positions."""
        return {"kind": "landmarks", "points": self.points.tolist()}


@dataclass(frozen=True, eq=False)
class CavityVolume:
    """The volume of a cavity, one number in mL.

    Parameters
    ----------
    scene : with the cavity in its mesh.
    facet_set : its wall; needed where the scene has several cavities.

    Raises
    ------
    InputError
        No such set, one that encloses nothing, or several cavities and no name.
    """

    scene: Scene
    facet_set: str | None = None

    quantity = "volume"
    unit = "mL"
    shape = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "facet_set", self.cavity.facet_set)

    @cached_property
    def cavity(self) -> Cavity:
        """The volume as a function of its wall's displacement."""
        return find_cavity(self.scene, self.facet_set)

    @property
    def nodes(self) -> np.ndarray:
        """Nodes of the cavity's wall, (k,)."""
        return self.cavity.nodes

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Volume (...) in mL."""
        return self.cavity(displacement)

    def describe(self) -> dict[str, Any]:
        """Kind and facet set."""
        return {"kind": "volume", "facet_set": self.facet_set}


@dataclass(frozen=True, eq=False)
class Observations:
    """What was measured at once, by name; one forward map serves all of it.

    nodes : (k,) the union of the nodes that the parts need, each once, the largest part's first.
    """

    parts: Mapping[str, Observation]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", MappingProxyType(dict(self.parts)))
        if not self.parts:
            raise InputError("nothing is observed; name one observation or more")
        for name in self.parts:
            if not isinstance(name, str) or not name or "/" in name:
                raise InputError(f"observation is called {name!r}; use a name without '/'")

    @cached_property
    def nodes(self) -> np.ndarray:
        """Nodes a forward map must return, (k,): those of the largest part first, in its order.

        A slice is what its rows then are: its reverse derivative scatters nothing, which for many
        theta at once is most of the time.
        """
        parts = sorted((part.nodes for part in self.parts.values()), key=len, reverse=True)
        nodes, first = np.unique(np.concatenate(parts), return_index=True)
        return nodes[np.argsort(first)]

    @cached_property
    def _rows(self) -> dict[str, np.ndarray | slice]:
        order = np.argsort(self.nodes)
        rows = {
            name: order[np.searchsorted(self.nodes, part.nodes, sorter=order)]
            for name, part in self.parts.items()
        }
        return {
            name: slice(len(k)) if np.array_equal(k, np.arange(len(k))) else k
            for name, k in rows.items()
        }

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each part's data."""
        return {name: part.shape for name, part in self.parts.items()}

    def __call__(self, displacement: jax.Array) -> dict[str, jax.Array]:
        """Data of each part without noise, from the displacement of ``nodes`` (..., k, 3) mm."""
        return {
            name: part(displacement[..., self._rows[name], :]) for name, part in self.parts.items()
        }

    def name[T](self, values: T | Mapping[str, T], what: str) -> dict[str, T]:
        """``values`` by the parts' names, in their order; one alone belongs to a single part.

        Raises
        ------
        InputError
            A part without a value, or a value without a part; ``what`` they are is said.
        """
        known = ", ".join(self.parts)
        if not isinstance(values, Mapping):
            if len(self.parts) > 1:
                raise InputError(f"{what}: give one for each of {known}, by name")
            return dict.fromkeys(self.parts, values)
        for name in (*values, *self.parts):
            if name not in self.parts:
                raise InputError(f"{what}: '{name}' is not observed; observed: {known}")
            if name not in values:
                raise InputError(f"{what}: nothing for '{name}'; observed: {known}")
        return {name: values[name] for name in self.parts}

    def describe(self) -> dict[str, Any]:
        """The description of each part; of a single one that bears its usual name, just that."""
        if len(self.parts) == 1:
            ((name, part),) = self.parts.items()
            if name == part.quantity:
                return part.describe()
        return {
            "kind": SEVERAL,
            "parts": {name: part.describe() for name, part in self.parts.items()},
        }


def observations(observe: Observation | Mapping[str, Observation] | Observations) -> Observations:
    """What was observed, by name; a single observation is called by its quantity."""
    if isinstance(observe, Observations):
        return observe
    return Observations(observe if isinstance(observe, Mapping) else {observe.quantity: observe})


def nodal_displacements(
    scene: Scene, nodes: str | np.ndarray | list[int] = "all"
) -> NodalDisplacements:
    """Observe ``nodes``: ``all``, the name of a node set, or indices.

    Raises
    ------
    InputError
        Unknown node or node set, or a node given twice.
    """
    if isinstance(nodes, str):
        index = all_nodes(scene) if nodes == "all" else scene.mesh.node_set(nodes)
    else:
        index = check_nodes(scene, np.asarray(nodes))
    if len(np.unique(index)) < len(index):
        values, counts = np.unique(index, return_counts=True)
        raise InputError(f"node {values[counts > 1][0]} is observed twice")
    return NodalDisplacements(index, scene.mesh.nodes[index])


def landmarks(scene: Scene, points: np.ndarray) -> Landmarks:
    """Observe material points given by reference positions ``points`` (d, 3) in mm.

    Raises
    ------
    InputError
        A point that lies in no element, nor just beside one.
    """
    scene.mesh.require_linear("a set of landmarks")
    points = np.atleast_2d(np.asarray(points, dtype=float))
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"landmarks have shape {points.shape}; expected (d, 3), finite, in mm")
    elements, weights = zip(*(_locate(scene, k, x) for k, x in enumerate(points)), strict=True)
    corners = scene.mesh.elements[list(elements)]
    nodes, position = np.unique(corners, return_inverse=True)
    return Landmarks(nodes, points, position.reshape(corners.shape), np.array(weights))


def _locate(scene: Scene, k: int, point: np.ndarray) -> tuple[int, np.ndarray]:
    """Element of ``point`` (3,) and its barycentric coordinates (4,) there.

    Measured surface points rarely lie on the mesh to the last digit: a point outside by less than
    ``_SLACK`` of the body's size is moved straight onto the nearest element.
    """
    corner = scene.mesh.nodes[scene.mesh.elements]
    gradients = scene.discretisation.gradients[:, 0]  # constant in a linear tetrahedron
    # The barycentric coordinate of corner a is 1 there and falls to 0 on the opposite face.
    coordinates = 1.0 + np.einsum("mai,mai->ma", gradients, point - corner)
    # Beyond a face, go back onto it along its normal; what then still lies outside, is clipped.
    rows = np.arange(len(coordinates))
    lowest = np.argmin(coordinates, axis=1)
    normal = gradients[rows, lowest]
    beyond = np.minimum(coordinates[rows, lowest], 0.0) / np.sum(normal**2, axis=1)
    inside = coordinates - beyond[:, None] * np.einsum("mai,mi->ma", gradients, normal)
    inside = np.maximum(inside, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    distances = np.linalg.norm(np.einsum("ma,mai->mi", inside, corner) - point, axis=1)
    element = int(np.argmin(distances))
    if distances[element] > _SLACK * scene.mesh.size:
        raise InputError(
            f"landmark {k} at {point.tolist()} mm lies outside the body, "
            f"about {distances[element]:.2g} mm away"
        )
    return element, inside[element]


def observation_from(scene: Scene, description: dict[str, Any]) -> Observation:
    """The operator that :meth:`Observation.describe` described."""
    kind = description.get("kind")
    if kind == "nodes":
        return nodal_displacements(scene, np.asarray(description["nodes"]))
    if kind == "landmarks":
        return landmarks(scene, np.asarray(description["points"]))
    if kind == "volume":
        return CavityVolume(scene, description["facet_set"])
    raise InputError(f"observation kind '{kind}' is unknown: nodes, landmarks or volume")


def observations_from(scene: Scene, description: dict[str, Any]) -> Observations:
    """What :meth:`Observations.describe` described."""
    if description.get("kind") != SEVERAL:
        return observations(observation_from(scene, description))
    parts = description["parts"].items()
    return Observations({name: observation_from(scene, part) for name, part in parts})


def spread_nodes(scene: Scene, count: int, seed: int) -> np.ndarray:
    """``count`` nodes drawn without replacement from those with a free component, sorted."""
    candidates = np.flatnonzero(~scene.held.all(axis=1))
    if not 0 < count <= len(candidates):
        raise InputError(
            f"cannot observe {count} nodes; scene '{scene.name}' has {len(candidates)} free"
        )
    return np.sort(np.random.default_rng(seed).choice(candidates, count, replace=False))


def spread_landmarks(scene: Scene, count: int, seed: int) -> np.ndarray:
    """``count`` points (count, 3) mm, uniform over the volume of the reference body."""
    rng = np.random.default_rng(seed)
    volumes = scene.discretisation.weights.sum(axis=1)
    elements = rng.choice(len(volumes), count, p=volumes / volumes.sum())
    barycentric = rng.dirichlet(np.ones(4), count)
    return np.einsum("da,dai->di", barycentric, scene.mesh.nodes[scene.mesh.elements[elements]])
