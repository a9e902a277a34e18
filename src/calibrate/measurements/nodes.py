"""Displacements of nodes of the mesh."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import jax
import numpy as np

from calibrate.measurements.points import (
    DISPLACEMENT,
    DISPLACEMENT_FIELD,
    DisplacementPoints,
    check_table,
    count_of,
)
from calibrate.measurements.protocol import Field
from emulator.core.errors import InputError
from emulator.scenes.nodes import all_nodes, check_nodes
from emulator.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class NodalDisplacements(DisplacementPoints):
    """Displacements of the nodes ``nodes`` (d,), at ``points`` (d, 3) in the reference body, mm."""

    nodes: np.ndarray
    points: np.ndarray

    kind: ClassVar[str] = "nodes"
    usage: ClassVar[str] = "nodes:N, all, a node set, node numbers like 3,14,15"

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """The displacements themselves."""
        return displacement

    def to_json(self) -> dict[str, Any]:
        """Kind and node indices."""
        return {"kind": self.kind, "nodes": self.nodes.tolist()}

    @classmethod
    def from_json(cls, scene: Scene, description: Mapping[str, Any]) -> Self:
        """The observation that :meth:`to_json` described."""
        return cls.of(scene, np.asarray(description["nodes"]))

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``nodes:N`` (N free ones at random), ``all``, a node set, or node numbers."""
        count = count_of(word, cls.kind)
        if count is not None:
            return DISPLACEMENT, cls.of(scene, spread_nodes(scene, count, seed))
        if word == "all" or word in scene.mesh.node_sets:
            return DISPLACEMENT, cls.of(scene, word)
        try:
            numbers = [int(text) for text in word.split(",")]
        except ValueError:
            return None
        return DISPLACEMENT, cls.of(scene, numbers)

    @classmethod
    def layouts(cls, words: Collection[str]) -> dict[str, tuple[Field, ...]]:
        """Node numbers and displacements."""
        return {DISPLACEMENT: (Field("node", ("node",), where=True), DISPLACEMENT_FIELD)}

    @classmethod
    def from_arrays(
        cls, scene: Scene, name: str, arrays: Mapping[str, np.ndarray]
    ) -> tuple[Self, np.ndarray]:
        """Observation and data from nodes (d,) and displacements (d, 3) in mm."""
        nodes, values = arrays["node"], arrays[DISPLACEMENT]
        check_table(nodes, values)
        if (nodes != np.round(nodes)).any():
            raise InputError("nodes must be whole numbers")
        return cls.of(scene, nodes.astype(int)), values

    def to_arrays(self, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """Nodes and displacements."""
        return {"node": self.nodes, DISPLACEMENT: np.asarray(values)}

    @classmethod
    def of(cls, scene: Scene, nodes: str | np.ndarray | list[int] = "all") -> Self:
        """See :func:`nodal_displacements`."""
        if isinstance(nodes, str):
            index = all_nodes(scene) if nodes == "all" else scene.mesh.node_set(nodes)
        else:
            index = check_nodes(scene, np.asarray(nodes))
        if len(np.unique(index)) < len(index):
            values, counts = np.unique(index, return_counts=True)
            raise InputError(
                f"node {values[counts > 1][0]} is observed twice; give each node once, repeated "
                "measurements as their mean, with less noise"
            )
        return cls(index, scene.mesh.nodes[index])


def nodal_displacements(
    scene: Scene, nodes: str | np.ndarray | list[int] = "all"
) -> NodalDisplacements:
    """Observe ``nodes``: ``all``, the name of a node set, or indices.

    Raises
    ------
    InputError
        Unknown node or node set, or a node given twice.
    """
    return NodalDisplacements.of(scene, nodes)


def spread_nodes(scene: Scene, count: int, seed: int) -> np.ndarray:
    """``count`` nodes drawn without replacement from those with a free component, sorted."""
    candidates = np.flatnonzero(~scene.held.all(axis=1))
    if not 0 < count <= len(candidates):
        raise InputError(
            f"cannot observe {count} nodes; scene '{scene.name}' has {len(candidates)} free"
        )
    return np.sort(np.random.default_rng(seed).choice(candidates, count, replace=False))
