"""The augmented graph: mesh nodes and edges, and coarser layers of virtual nodes above them.

Messages travel one edge a step, so K steps over mesh edges alone reach K elements far. Virtual
nodes, the centres of a k-means clustering of the layer below and joined to their kappa nearest
neighbours, carry messages across the body (Dalton et al. 2023, Section 2.2).

The mid-side nodes of quadratic tetrahedra are nodes of the graph, joined to the two corners of
their edge; they replace the edge between those corners.

For a network that has learned a family of ventricles (:func:`describe`), features are products of
vectors that turn with the body (:mod:`emulator.geometry.heart_wall`),
lengths over its size L and volumes over L^3. So a ventricle moved, turned or enlarged has the same
features, and its displacement over L, with respect to its own vectors, is the same too, as it is in
mechanics without gravity. Features are standardised by means and deviations of the family that the
network was trained on, not of the body at hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.heart_wall import Ventricle, ventricle
from emulator.geometry.mesh import EDGES, frozen_array
from emulator.scenes.scene import Scene, find_cavity

CLUSTER = 4
"""The mean number of nodes of a layer for each node of the layer above it."""
NEIGHBOURS = 4
"""The number kappa of nearest neighbours that each virtual node is joined to."""
_SMALLEST = 8  # least number of nodes of a layer; the last layer is joined completely
_NEAREST = 1e-3  # least distance over L in a logarithm
_REPEATED = ("wall over cavity", "length", "radius", "helix", "helix gradient")
"""Numbers of the whole body that are features of every node, so that no message carries them."""


@dataclass(frozen=True, eq=False)
class AugmentedGraph:
    """Inputs of the processor. Each pair of joined nodes is stored once, from sender to receiver.

    node_features : the normalised features (N, d), mesh nodes first (Eq. 24-25).
    edge_features : the normalised relative position and distance (E, 4), receiver minus sender.
    senders, receivers : the node indices (E,) of each edge, sender > receiver.
    real : number of mesh nodes.
    """

    node_features: np.ndarray
    edge_features: np.ndarray
    senders: np.ndarray
    receivers: np.ndarray
    real: int

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the four arrays by name."""
        names = ("node_features", "edge_features", "senders", "receivers")
        return {name: getattr(self, name) for name in names}


def augment(scene: Scene) -> AugmentedGraph:
    """Return the augmented graph of a scene's mesh; equal for equal scenes."""
    layers = hierarchy(scene.mesh.nodes, mesh_edges(scene.mesh.elements))
    pairs = layers.pairs
    receivers, senders = pairs[:, 0], pairs[:, 1]
    positions = layers.extend(scene.mesh.nodes)
    relative = positions[receivers] - positions[senders]
    length = np.linalg.norm(relative, axis=1, keepdims=True)
    return AugmentedGraph(
        node_features=frozen_array(_normalise(layers.extend(node_inputs(scene))), np.float32),
        edge_features=frozen_array(_normalise(np.hstack([relative, length])), np.float32),
        senders=frozen_array(senders, np.int32),
        receivers=frozen_array(receivers, np.int32),
        real=len(scene.mesh.nodes),
    )


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Mesh nodes and the virtual layers above them.

    pairs : the joined nodes (E, 2), receiver < sender, each pair once.
    parents : the cluster that each node lies in, for each layer but the last.
    """

    pairs: np.ndarray
    parents: tuple[np.ndarray, ...]

    def extend(self, values: np.ndarray) -> np.ndarray:
        """Return ``values`` (n, d) of the mesh nodes and their means over clusters, (N, d)."""
        each = [values]
        for parent in self.parents:
            each.append(_cluster_means(each[-1], parent, int(parent.max()) + 1))
        return np.concatenate(each)


def hierarchy(positions: np.ndarray, edges: np.ndarray) -> Hierarchy:
    """Return virtual layers above the nodes at ``positions`` (n, 3), joined by ``edges`` (e, 2)."""
    from sklearn.cluster import KMeans  # slow to import; a cached emulator needs no graph
    from sklearn.neighbors import NearestNeighbors

    layer_edges, parents, offset = [edges], [], 0
    while (count := len(positions) // CLUSTER) >= _SMALLEST:
        parent = KMeans(count, n_init=1, random_state=0).fit(positions).labels_
        parents.append(parent)
        above = offset + len(positions)
        layer_edges.append(np.column_stack([offset + np.arange(len(positions)), above + parent]))
        positions = _cluster_means(positions, parent, count)
        if count // CLUSTER < _SMALLEST:
            layer_edges.append(above + np.column_stack(np.triu_indices(count, 1)))
        else:
            nearest = NearestNeighbors(n_neighbors=NEIGHBOURS + 1).fit(positions)
            index = nearest.kneighbors(positions, return_distance=False)
            joined = [np.repeat(index[:, 0], NEIGHBOURS), index[:, 1:].ravel()]
            layer_edges.append(above + np.column_stack(joined))
        offset = above
    pairs = np.unique(np.sort(np.concatenate(layer_edges), axis=1), axis=0)
    return Hierarchy(pairs, tuple(parents))


def node_inputs(scene: Scene) -> np.ndarray:
    """Return the features (n, d) of the mesh nodes: supports, prescribed displacement, position.

    The displacement is left out where all prescribed ones are zero. Positions are relative to the
    mean of the nodes, so that a translated body has the same features.
    """
    columns = [scene.held.astype(float)]
    if scene.held_displacement.any():
        columns.append(scene.held_displacement)
    columns.append(scene.mesh.nodes - scene.mesh.nodes.mean(axis=0))
    return np.hstack(columns)


def mesh_edges(elements: np.ndarray) -> np.ndarray:
    """Return the pairs of nodes (e, 2) joined by an edge of a tetrahedron (m, 4 or 10).

    The edge a, b of a quadratic tetrahedron is two: a to its mid-side node and that node to b.
    """
    if elements.shape[1] == 4:
        local = list(EDGES)
    else:
        local = [(end, 4 + k) for k, edge in enumerate(EDGES) for end in edge]
    pairs = np.concatenate([elements[:, list(pair)] for pair in local])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _cluster_means(values: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    sums = np.zeros((count, values.shape[1]))
    np.add.at(sums, labels, values)
    sizes = np.bincount(labels, minlength=count)
    if not sizes.all():
        raise InputError("graph: a cluster of nodes is empty; are there duplicate nodes?")
    return sums / sizes[:, None]


def _normalise(values: np.ndarray) -> np.ndarray:
    """Return columns of mean 0 and standard deviation 1; a constant column becomes 0."""
    sd = values.std(axis=0)
    return (values - values.mean(axis=0)) / np.where(sd > 1e-12, sd, 1.0)


class BodyFeatures(NamedTuple):
    """A ventricle as the network of a family is told of it.

    graph : the graph, its features before standardisation.
    vectors : the vectors of which the output is a combination, (n, 7, 3) mm.
    shares : the part of the wall's volume at each node, (n,).
    shape : the numbers that describe the whole body, by name.
    """

    graph: AugmentedGraph
    vectors: np.ndarray
    shares: np.ndarray
    shape: dict[str, float]


def describe(scene: Scene) -> BodyFeatures:
    """Return the ventricle of ``scene``.

    Refused are no fibres, no cavity under pressure or several, and what
    :func:`~emulator.geometry.heart_wall.ventricle` refuses.
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
    positions, normals = layers.extend(body.offset), layers.extend(body.normal)
    edges = _edges(positions, normals, body.axis, layers.pairs)
    graph = AugmentedGraph(nodes, edges, senders, receivers, len(scene.mesh.nodes))
    return BodyFeatures(graph, body.vectors() * body.size, body.volume / body.wall, shape)


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
