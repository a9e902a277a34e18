r"""Displacements of nodes and of material points, and lengths between them.

A material point at X moves by the displacements of its element's nodes, weighted by the element's
shape functions. The distance between two landmarks, such as base and apex, is

.. math:: \ell = |x_B - x_A|, \qquad x_A = \sum_a w_a\, (X_a + u_a) ,

where a landmark is a weighted mean of nodes: one node, a material point (the weights are shape
functions), or the mean of a node set, to which each node counts the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_array, eye_array, kron

from calibrate.measurements.location import locate
from calibrate.measurements.observation import DataField, Layout, Scalar
from calibrate.measurements.points import XYZ, DisplacementPoints, as_points, gather
from calibrate.measurements.words import names_of
from emulator.core.errors import InputError
from emulator.geometry.discretisation import shapes_at
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, all_nodes, check_nodes

_SHORTEST = 1e-6  # in sizes of the body; the direction of a shorter length is round-off


def spread_nodes(scene: ForwardProblem, count: int, seed: int) -> np.ndarray:
    """Return ``count`` nodes drawn without replacement from those with a free component, sorted."""
    if not isinstance(scene, Scene):
        raise InputError(
            f"observe nodes: '{scene.name}' has no mesh; give --data FILE, or --observe NAMES of "
            "what it has, as stress"
        )
    candidates = np.flatnonzero(~scene.held.all(axis=1))
    if not 0 < count <= len(candidates):
        raise InputError(
            f"cannot observe {count} nodes; scene '{scene.name}' has {len(candidates)} free"
        )
    return np.sort(np.random.default_rng(seed).choice(candidates, count, replace=False))


def spread_landmarks(scene: Scene, count: int, seed: int) -> np.ndarray:
    """Return ``count`` points (count, 3) mm, uniform over the volume of the reference body."""
    mesh, rng = scene.mesh, np.random.default_rng(seed)
    volumes = scene.discretisation.weights.sum(axis=1)
    elements = rng.choice(len(volumes), count, p=volumes / volumes.sum())
    # Uniform in the reference element: uniform in an element with straight edges.
    barycentric = rng.dirichlet(np.ones(4), count)
    weights, _ = shapes_at(mesh.order, barycentric)
    return np.einsum("da,dai->di", weights, mesh.nodes[mesh.elements[elements]])


@dataclass(frozen=True, eq=False)
class NodalDisplacements(DisplacementPoints):
    """Displacements of the nodes ``nodes`` (d,), at ``points`` (d, 3) in the reference body, mm."""

    nodes: np.ndarray
    points: np.ndarray

    kind = "nodes"
    hint = ", or all, a node set, node numbers like 3,14,15"
    place = "nodes"
    place_field = DataField("node", ("node",), where=True)
    spread = staticmethod(spread_nodes)

    @property
    def row_names(self) -> list[str]:
        """The number of each node, and where it is."""
        at = super().row_names
        return [f"of node {node} {words}" for node, words in zip(self.nodes, at, strict=True)]

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the displacements themselves."""
        return displacement

    @property
    def matrix(self) -> csr_array:
        """The identity."""
        return eye_array(3 * len(self.nodes), format="csr")

    @classmethod
    def of(cls, scene: Scene, nodes: str | np.ndarray | list[int] = "all") -> Self:
        """Return the observation of ``nodes``: ``all``, the name of a node set, or indices.

        Raises
        ------
        InputError
            Unknown node or node set, or a node given twice.
        """
        if isinstance(nodes, str):
            index = all_nodes(scene) if nodes == "all" else scene.mesh.node_set(nodes)
        else:
            index = np.asarray(nodes)
            if index.dtype == float:  # as files have them
                if (index != np.round(index)).any():
                    raise InputError("nodes must be whole numbers")
                index = index.astype(int)
            index = check_nodes(scene, index)
        numbers, counts = np.unique(index, return_counts=True)
        if (counts > 1).any():
            raise InputError(
                f"node {numbers[counts > 1][0]} is observed twice; give each node once, repeated "
                "measurements as their mean, with less noise"
            )
        return cls(index, scene.mesh.nodes[index])


def nodes_called(scene: Scene, word: str) -> NodalDisplacements | None:
    """Return the observation of ``all`` nodes, a node set or numbers; None for other words."""
    if word == "all" or word in scene.mesh.node_sets:
        return NodalDisplacements.of(scene, word)
    try:
        numbers = [int(text) for text in word.split(",")]
    except ValueError:
        return None
    return NodalDisplacements.of(scene, numbers)


@dataclass(frozen=True, eq=False)
class Landmarks(DisplacementPoints):
    """Displacements of material points, interpolated by the shape functions of their element.

    nodes : the nodes of the points' elements, (k,).
    points : positions in the reference body, mm, (d, 3).
    members : positions in ``nodes`` of each point's element, (d, 4 or 10).
    weights : shape functions of the element at the point, (d, 4 or 10).
    """

    nodes: np.ndarray
    points: np.ndarray
    members: np.ndarray
    weights: np.ndarray

    kind = "landmarks"
    place_field = DataField("position", XYZ, where=True)
    spread = staticmethod(spread_landmarks)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return interpolated displacements (..., d, 3)."""
        values = displacement[..., self.members, :]
        return jnp.sum(values * self.weights[:, :, None], axis=-2)

    @property
    def matrix(self) -> csr_array:
        """The shape functions at the points, for each component."""
        rows = np.repeat(np.arange(len(self.members)), self.members.shape[1])
        entries = (self.weights.ravel(), (rows, self.members.ravel()))
        of_one = csr_array(entries, shape=(len(self.members), len(self.nodes)))
        return csr_array(kron(of_one, np.eye(3)))

    @classmethod
    def of(cls, scene: Scene, points: Any) -> Self:
        """Return the observation of material points at reference positions ``points`` (d, 3) in mm.

        Raises
        ------
        InputError
            A point that lies neither in an element nor just beside one, or is given twice.
        """
        points = as_points(points, "landmarks")
        elements, inside = locate(scene.mesh, points)
        nodes, members = gather(scene.mesh.elements[elements])
        return cls(nodes, points, members, shapes_at(scene.mesh.order, inside)[0])

    @classmethod
    def read(
        cls, scene: Scene, layout: Layout, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Return the observation and its data; positions must be those at rest."""
        try:
            return super().read(scene, layout, arrays)
        except InputError as error:
            if _are_deformed(scene, *(arrays[field.variable] for field in layout.fields)):
                raise InputError(
                    f"{error}; less their displacements all points lie inside: give positions at "
                    "rest"
                ) from error
            raise


def _are_deformed(scene: Scene, points: np.ndarray, values: np.ndarray) -> bool:
    """Return whether points (d, 3) lie in the body only once displacements are subtracted."""
    if points.shape != values.shape or points.shape[1:] != (3,):
        return False
    measured = np.isfinite(values).all(axis=1)
    try:
        locate(scene.mesh, points[measured] - values[measured])
    except InputError:
        return False
    return bool(measured.any())


@dataclass(frozen=True, eq=False)
class Length(Scalar):
    """The distance between two landmarks, one number in mm.

    first, second : the landmarks in words.
    nodes : the nodes that either landmark is made of, (k,).
    weights : weights of the nodes in each landmark, (2, k); rows sum to 1.
    ends : the landmarks in the reference body, mm, (2, 3).
    """

    first: str
    second: str
    nodes: np.ndarray
    weights: np.ndarray
    ends: np.ndarray

    kind = "length"
    hint = ", each a node, a node set or x,y,z"
    quantity = "length"
    unit = "mm"
    usual_sd = 0.5
    arguments = ("first", "second")

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the length (...) in mm."""
        x = self.ends + jnp.einsum("ek,...ki->...ei", self.weights, displacement)
        return jnp.linalg.norm(x[..., 1, :] - x[..., 0, :], axis=-1)

    @classmethod
    def of(cls, scene: Scene, first: str, second: str) -> Self:
        """Return the observation of the distance between two landmarks.

        Parameters
        ----------
        first, second : the number of a node, the name of a node set, or ``x,y,z`` in mm, as text.

        Raises
        ------
        InputError
            An unknown node or set, a point outside the body, or two landmarks at one place.
        """
        landmarks = [_landmark(scene, text) for text in (first, second)]
        nodes = np.unique(np.concatenate([members for members, _ in landmarks]))
        weights = np.zeros((2, len(nodes)))
        for row, (members, shares) in zip(weights, landmarks, strict=True):
            row[np.searchsorted(nodes, members)] = shares
        ends = weights @ scene.mesh.nodes[nodes]
        part = cls(first, second, nodes, weights, ends)
        if not np.linalg.norm(ends[1] - ends[0]) > _SHORTEST * scene.mesh.size:
            raise InputError(
                f"observe '{names_of(part)[0]}': both landmarks are at {ends[0].tolist()} mm"
            )
        return part


nodal_displacements = NodalDisplacements.of
landmarks = Landmarks.of
length_between = Length.of


def _landmark(scene: Scene, text: str) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of a landmark."""
    if text in scene.mesh.node_sets:
        nodes = scene.mesh.node_set(text)
        return nodes, np.full(len(nodes), 1.0 / len(nodes))
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 3 and np.isfinite(numbers).all():
        elements, inside = locate(scene.mesh, np.array([numbers]))
        return scene.mesh.elements[elements[0]], shapes_at(scene.mesh.order, inside)[0][0]
    if len(numbers) == 1 and text.isdigit():
        return check_nodes(scene, np.array([int(text)])), np.ones(1)
    known = ", ".join(sorted(scene.mesh.node_sets)) or "none here"
    raise InputError(f"landmark '{text}' is neither a node, a node set ({known}) nor x,y,z")
