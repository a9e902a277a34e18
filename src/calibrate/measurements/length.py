r"""The distance between two landmarks, such as base and apex.

.. math:: \ell = |x_B - x_A|, \qquad x_A = \sum_a w_a\, (X_a + u_a)

A landmark is a weighted mean of nodes: one node, a material point (the weights are shape functions
of its element), or the mean of a node set, to which each node counts the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.location import locate
from calibrate.measurements.protocol import LENGTH_UNITS
from calibrate.measurements.scalar import Scalar
from calibrate.noise.gaussian import GaussianNoise
from emulator.core.errors import InputError
from emulator.scenes.nodes import check_nodes
from emulator.scenes.scene import Scene

_SHORTEST = 1e-6  # of the body's size; the direction of a shorter length is round-off


@dataclass(frozen=True, eq=False)
class Length(Scalar):
    """The distance between two landmarks, one number in mm.

    word : as on the command line.
    nodes : (k,) that either landmark is made of.
    weights : (2, k) of the nodes in each landmark; rows sum to 1.
    ends : (2, 3) mm, the landmarks in the reference body.
    """

    word: str
    nodes: np.ndarray
    weights: np.ndarray
    ends: np.ndarray

    kind: ClassVar[str] = "length"
    usage: ClassVar[str] = "length:A:B (each a node, a node set or x,y,z)"
    quantity: ClassVar[str] = "length"
    unit: ClassVar[str] = "mm"
    other_units: ClassVar[Mapping[str, float]] = LENGTH_UNITS
    default_noise: ClassVar[GaussianNoise] = GaussianNoise(sd=0.5)

    @property
    def names(self) -> tuple[str, ...]:
        """The word itself."""
        return (self.word,)

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Length (...) in mm."""
        x = self.ends + jnp.einsum("ek,...ki->...ei", self.weights, displacement)
        return jnp.linalg.norm(x[..., 1, :] - x[..., 0, :], axis=-1)

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``length:base:apex_epicardium``, ``length:3:14`` or ``length:0,0,-58:3``."""
        kind, *landmarks = word.split(":")
        if kind != cls.kind:
            return None
        if len(landmarks) != 2 or not all(landmarks):
            raise InputError(f"observe '{word}': give {cls.usage}")
        return word, cls.of(scene, word, *landmarks)

    @classmethod
    def of(cls, scene: Scene, word: str, *landmarks: str) -> Self:
        """The distance between two ``landmarks``, each a node, a node set or x,y,z."""
        found = [_landmark(scene, text) for text in landmarks]
        nodes = np.unique(np.concatenate([members for members, _ in found]))
        weights = np.zeros((2, len(nodes)))
        for row, (members, shares) in zip(weights, found, strict=True):
            row[np.searchsorted(nodes, members)] = shares
        ends = weights @ scene.mesh.nodes[nodes]
        if not np.linalg.norm(ends[1] - ends[0]) > _SHORTEST * scene.mesh.size:
            raise InputError(f"observe '{word}': both landmarks are at {ends[0].tolist()} mm")
        return cls(word, nodes, weights, ends)


def length_between(scene: Scene, first: str, second: str) -> Length:
    """Observe the distance between two landmarks.

    Parameters
    ----------
    first, second : the number of a node, the name of a node set, or ``x,y,z`` in mm, as text.

    Raises
    ------
    InputError
        An unknown node or set, a point outside the body, or two landmarks at one place.
    """
    return Length.of(scene, f"{Length.kind}:{first}:{second}", first, second)


def _landmark(scene: Scene, text: str) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of a landmark."""
    if text in scene.mesh.node_sets:
        nodes = scene.mesh.node_set(text)
        return nodes, np.full(len(nodes), 1.0 / len(nodes))
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 3 and np.isfinite(numbers).all():
        elements, shapes = locate(scene.mesh, np.array([numbers]))
        return scene.mesh.elements[elements[0]], shapes[0]
    if len(numbers) == 1 and text.isdigit():
        return check_nodes(scene, np.array([int(text)])), np.ones(1)
    known = ", ".join(sorted(scene.mesh.node_sets)) or "none here"
    raise InputError(f"landmark '{text}' is neither a node, a node set ({known}) nor x,y,z")
