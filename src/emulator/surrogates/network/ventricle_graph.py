r"""Features of a ventricle for a network that has learned a family of them.

All features are products of vectors that turn with the body (:mod:`emulator.geometry.heart_wall`),
lengths over its size L and volumes over L^3. So a ventricle moved, turned or enlarged has the same
features, and its displacement over L, with respect to its own vectors, is the same too, as it is in
mechanics without gravity. Features are standardised by means and deviations of the family that the
network was trained on, not of the body at hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.heart_wall import Ventricle, ventricle
from emulator.scenes.scene import Scene, find_cavity
from emulator.surrogates.network.graph import hierarchy, mesh_edges

_NEAREST = 1e-3  # least distance over L in a logarithm


class BodyFeatures(NamedTuple):
    """The features of a ventricle before standardisation.

    nodes : the features of the nodes, mesh nodes first, then virtual ones, (N, d).
    edges : the features of the edges, (E, 4).
    senders, receivers : the nodes that each edge joins, (E,).
    real : the number of mesh nodes.
    vectors : the vectors of which the output is a combination, (n, 7, 3) mm.
    shares : the part of the wall's volume at each node, (n,).
    shape : the numbers that describe the whole body, by name.
    """

    nodes: np.ndarray
    edges: np.ndarray
    senders: np.ndarray
    receivers: np.ndarray
    real: int
    vectors: np.ndarray
    shares: np.ndarray
    shape: dict[str, float]


def describe(scene: Scene) -> BodyFeatures:
    """Return the ventricle of ``scene``.

    Raises
    ------
    InputError
        No fibres, no cavity under pressure, or more than one; see
        :func:`~emulator.geometry.heart_wall.ventricle`.
    """
    if scene.fibres is None:
        raise InputError(f"scene '{scene.name}' has no fibres; this network was trained with them")
    if scene.angles:
        raise InputError(
            f"scene '{scene.name}': theta turns its fibres, and this network was trained with "
            "fibres that are known; train one for the scene"
        )
    cavity = find_cavity(scene).facet_set
    try:
        body = ventricle(scene.mesh, cavity, scene.held.all(axis=1))
    except InputError as error:
        raise InputError(f"scene '{scene.name}' is no ventricle to this network: {error}") from None
    fibres = _fibre_tensor(body, scene)
    shape = _shape(body, fibres)
    local = np.column_stack([_places(body), _along_fibres(body, fibres)])
    numbers = np.array([shape[name] for name in _REPEATED])
    layers = hierarchy(body.offset, mesh_edges(scene.mesh.elements))
    nodes = layers.extend(np.column_stack([local, np.tile(numbers, (len(local), 1))]))
    receivers, senders = layers.pairs.T
    vectors = body.vectors()
    positions, normals = layers.extend(body.offset), layers.extend(body.normal)
    return BodyFeatures(
        nodes=nodes,
        edges=_edges(positions, normals, body.axis, layers.pairs),
        senders=senders,
        receivers=receivers,
        real=len(scene.mesh.nodes),
        vectors=vectors * body.size,
        shares=body.volume / body.wall,
        shape=shape,
    )


_REPEATED = ("wall over cavity", "length", "radius", "helix", "helix gradient")
"""Numbers of the whole body that are features of every node, so that no message carries them."""


def _shape(body: Ventricle, fibres: np.ndarray) -> dict[str, float]:
    """Return the numbers by which a body is compared with the family of a network."""
    rim = body.inner & body.held
    shares = body.volume / body.wall
    helix = np.einsum("ni,nij,j->n", body.circumference, fibres, body.axis)
    return {
        "size": body.size,
        "wall over cavity": float(np.log(body.wall / body.cavity)),
        "length": float(-body.height[body.inner].min()),
        "radius": float(np.linalg.norm(body.across[rim], axis=1).mean()),
        "helix": float(shares @ helix),
        "helix gradient": float(shares @ (helix * (body.depth - 0.5))),
        "thicker": float(np.linalg.norm(body.lean)),
        "spacing": float(np.log(len(body.depth))),
    }


def _places(body: Ventricle) -> np.ndarray:
    """Return the features of the nodes' places, (n, 13)."""
    n, x, lean = body.normal, body.across, body.lean
    return np.column_stack(
        [
            body.held,
            body.inner,
            body.depth,
            body.depth**2,
            body.height,
            np.linalg.norm(x, axis=1),
            n @ body.axis,
            np.einsum("ni,ni->n", n, x),
            n @ lean,
            x @ lean,
            np.cross(body.axis, x) @ lean,
            np.cbrt(body.volume),
            np.log(np.maximum(-body.height, _NEAREST)),
        ]
    )


def _along_fibres(body: Ventricle, fibres: np.ndarray) -> np.ndarray:
    """Return products of the fibres with the node's vectors, (n, 6); a fibre has no sign."""
    n, c = body.normal, body.circumference
    k = np.broadcast_to(body.axis, n.shape)
    pairs = ((k, k), (n, n), (c, c), (c, k), (n, k), (n, c))
    return np.column_stack([np.einsum("ni,nij,nj->n", a, fibres, b) for a, b in pairs])


def _fibre_tensor(body: Ventricle, scene: Scene) -> np.ndarray:
    """Return the mean of f f^T over the elements at each node, weighted by volume, (n, 3, 3)."""
    elements, fibres = scene.mesh.elements, scene.fibres_at_points
    each = np.einsum("mq,mqi,mqj->mij", scene.discretisation.weights, fibres, fibres)
    total = np.zeros((len(body.depth), 3, 3))
    np.add.at(total, elements, each[:, None])
    return total / np.trace(total, axis1=1, axis2=2)[:, None, None]


def _edges(x: np.ndarray, normals: np.ndarray, axis: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return positions from sender to receiver along n, c and k of their middle, and lengths."""
    receivers, senders = pairs.T
    relative = x[receivers] - x[senders]
    n = 0.5 * (normals[receivers] + normals[senders])
    c = np.cross(axis, n)
    length = np.linalg.norm(relative, axis=1)
    parts = [np.einsum("ei,ei->e", relative, direction) for direction in (n, c)]
    return np.column_stack([*parts, relative @ axis, length])
