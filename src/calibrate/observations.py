"""Observation operators: what of a displacement field was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from emulator.errors import InputError
from emulator.forward import all_nodes, check_nodes
from emulator.scenes.scene import Scene

# How far outside the body a point may lie, as a fraction of the body's size.
_SLACK = 1e-3


class Observation(Protocol):
    """Linear in the displacement of a few nodes.

    nodes : (k,) the nodes a forward map must return.
    points : (d, 3) mm, where in the reference body each row of the data lies.
    """

    @property
    def nodes(self) -> np.ndarray:
        """Nodes a forward map must return, (k,)."""
        ...

    @property
    def points(self) -> np.ndarray:
        """Reference positions of the data's rows, (d, 3) mm."""
        ...

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Observed displacements (..., d, 3) in mm from those of ``nodes`` (..., k, 3)."""
        ...

    def describe(self) -> dict[str, Any]:
        """Plain JSON from which :func:`observation_from` makes it again."""
        ...


@dataclass(frozen=True, eq=False)
class NodalDisplacements:
    """Displacements of some nodes, in mm."""

    nodes: np.ndarray
    points: np.ndarray

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """The displacements themselves."""
        return displacement

    def describe(self) -> dict[str, Any]:
        """Kind and node indices."""
        return {"kind": "nodes", "nodes": self.nodes.tolist()}


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Displacements of material points between nodes, by linear interpolation in their element.

    corners : (d, 4) positions in ``nodes`` of each point's element.
    weights : (d, 4) barycentric coordinates.
    """

    nodes: np.ndarray
    points: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    def __call__(self, displacement: jax.Array) -> jax.Array:
        """Interpolated displacements (..., d, 3)."""
        corner_values = displacement[..., self.corners, :]
        return jnp.sum(corner_values * self.weights[:, :, None], axis=-2)

    def describe(self) -> dict[str, Any]:
        """Kind and reference positions."""
        return {"kind": "landmarks", "points": self.points.tolist()}


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
    if description.get("kind") == "nodes":
        return nodal_displacements(scene, np.asarray(description["nodes"]))
    if description.get("kind") == "landmarks":
        return landmarks(scene, np.asarray(description["points"]))
    raise InputError(f"observation kind '{description.get('kind')}' is unknown: nodes or landmarks")


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
