"""A scene on finer elements of its own polyhedron: each tetrahedron in eight, or quadratic."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

import emulator as em

# Local nodes of a quadratic tetrahedron: four at its corners, four around the diagonal from 4 (on
# edge 01) to 9 (on edge 23).
_EIGHT = (
    (0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3),
    (4, 9, 6, 7), (4, 9, 7, 8), (4, 9, 8, 5), (4, 9, 5, 6),
)  # fmt: skip
_EDGES = ([0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3])
_FOUR = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # of a facet: corners, then 01, 12, 20


def in_eight(mesh: em.Mesh) -> em.Mesh:
    """``mesh`` of linear tetrahedra with each of them cut in eight, one after the other."""
    whole = em.geometry.to_quadratic(mesh)
    elements = whole.elements[:, _EIGHT].reshape(-1, 4)
    inverted = em.geometry.signed_volumes(whole.nodes, elements) < 0.0
    elements[inverted] = elements[inverted][:, [0, 1, 3, 2]]
    facets = {name: rows[:, _FOUR].reshape(-1, 3) for name, rows in whole.facet_sets.items()}
    return em.Mesh(whole.nodes, elements, dict(whole.node_sets), facets)


def refined(scene: em.Scene) -> em.Scene:
    """``scene`` with each tetrahedron cut in eight."""
    return _on(scene, in_eight, 8)


def quadratic(scene: em.Scene) -> em.Scene:
    """``scene`` on quadratic tetrahedra with straight edges."""
    return _on(scene, em.geometry.to_quadratic, 1)


def _on(scene: em.Scene, change: Callable[[em.Mesh], em.Mesh], children: int) -> em.Scene:
    """``scene`` on another mesh of its polyhedron; held nodes between held ones move between."""
    whole = em.geometry.to_quadratic(scene.mesh)
    parents = np.tile(np.arange(len(whole.nodes))[:, None], (1, 2))  # a corner is its own
    for middle, ends in enumerate(_EDGES, 4):
        parents[whole.elements[:, middle]] = whole.elements[:, ends]
    held = scene.held_displacement[parents].mean(axis=1)
    mesh = change(scene.mesh)
    supports = []
    for support in scene.supports:
        assert isinstance(support, em.Support), support.kind
        there = held[mesh.node_set(support.node_set)]
        supports.append(replace(support, displacement=there))
    fibres = None if scene.fibres is None else np.repeat(scene.fibres, children, axis=0)
    return replace(scene, mesh=mesh, supports=tuple(supports), fibres=fibres, origin={})
