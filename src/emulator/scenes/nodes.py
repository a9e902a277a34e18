"""Nodes of a scene by their numbers."""

from __future__ import annotations

import numpy as np

from emulator.core.errors import InputError
from emulator.scenes.scene import Scene


def all_nodes(scene: Scene) -> np.ndarray:
    """Indices of every node of the scene, (n,)."""
    return np.arange(len(scene.mesh.nodes))


def check_nodes(scene: Scene, nodes: np.ndarray) -> np.ndarray:
    """``nodes`` as integers; :class:`InputError` unless each is a node of the scene."""
    nodes = np.atleast_1d(np.asarray(nodes))
    if nodes.size == 0 or not np.issubdtype(nodes.dtype, np.integer):
        raise InputError("observed nodes must be a list of whole numbers, not empty")
    unknown = nodes[(nodes < 0) | (nodes >= len(scene.mesh.nodes))]
    if unknown.size:
        raise InputError(
            f"node {unknown[0]} is unknown; scene '{scene.name}' has nodes 0 to "
            f"{len(scene.mesh.nodes) - 1}"
        )
    return nodes
