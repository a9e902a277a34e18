"""The augmented graph: mesh nodes and edges, and coarser layers of virtual nodes above them.

Messages travel one edge a step, so K steps over mesh edges alone reach K elements far. Virtual
nodes, the centres of a k-means clustering of the layer below and joined to their kappa nearest
neighbours, carry messages across the body (Dalton et al. 2023, Section 2.2).

The mid-side nodes of quadratic tetrahedra are nodes of the graph, joined to the two corners of
their edge; they replace the edge between those corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import EDGES, frozen_array
from emulator.scenes.scene import Scene

CLUSTER = 4
"""The mean number of nodes of a layer for each node of the layer above it."""
NEIGHBOURS = 4
"""The number kappa of nearest neighbours that each virtual node is joined to."""
_SMALLEST = 8  # least number of nodes of a layer; the last layer is joined completely


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
class Coarsenings:
    """Mesh nodes and the virtual layers above them.

    pairs : the joined nodes (E, 2), receiver < sender, each pair once.
    parents : the cluster that each node lies in, for each layer but the last.
    """

    pairs: np.ndarray
    parents: tuple[np.ndarray, ...]

    def extend(self, values: np.ndarray) -> np.ndarray:
        """Return ``values`` (n, d) of the mesh nodes and their means over clusters, (N, d)."""
        layers = [values]
        for parent in self.parents:
            layers.append(cluster_means(layers[-1], parent, int(parent.max()) + 1))
        return np.concatenate(layers)


def hierarchy(positions: np.ndarray, edges: np.ndarray) -> Coarsenings:
    """Return virtual layers above the nodes at ``positions`` (n, 3), joined by ``edges`` (e, 2)."""
    layer_edges, parents, offset = [edges], [], 0
    while (count := len(positions) // CLUSTER) >= _SMALLEST:
        parent = clusters(positions, count)
        parents.append(parent)
        above = offset + len(positions)
        layer_edges.append(np.column_stack([offset + np.arange(len(positions)), above + parent]))
        positions = cluster_means(positions, parent, count)
        if count // CLUSTER < _SMALLEST:
            layer_edges.append(above + np.column_stack(np.triu_indices(count, 1)))
        else:
            layer_edges.append(above + neighbours(positions, NEIGHBOURS))
        offset = above
    pairs = np.unique(np.sort(np.concatenate(layer_edges), axis=1), axis=0)
    return Coarsenings(pairs, tuple(parents))


def clusters(positions: np.ndarray, count: int, weights: np.ndarray | None = None) -> np.ndarray:
    """Return the cluster, of ``count``, that each of the ``positions`` (n, 3) lies in, (n,).

    weights : of the positions, (n,); equal by default.
    """
    from sklearn.cluster import KMeans  # slow to import; a cached emulator needs no graph

    return KMeans(count, n_init=1, random_state=0).fit(positions, sample_weight=weights).labels_


def nearest(
    centres: np.ndarray, positions: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``count`` centres nearest to each position and their distances, (n, count)."""
    from sklearn.neighbors import NearestNeighbors  # slow to import

    search = NearestNeighbors(n_neighbors=count).fit(centres)
    distances, index = search.kneighbors(positions)
    return index, distances


def neighbours(positions: np.ndarray, count: int) -> np.ndarray:
    """Return the pairs of each position and its ``count`` nearest ones, (n count, 2)."""
    index, _ = nearest(positions, positions, count + 1)
    return np.column_stack([np.repeat(index[:, 0], count), index[:, 1:].ravel()])


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


def cluster_means(
    values: np.ndarray, labels: np.ndarray, count: int, weights: np.ndarray | None = None
) -> np.ndarray:
    """Return the means (count, d) over clusters of ``values`` (n, d), by ``weights`` (n,)."""
    sizes = np.bincount(labels, weights, count)
    sums = np.zeros((count, values.shape[1]))
    np.add.at(sums, labels, values if weights is None else values * weights[:, None])
    if not sizes.all():
        raise InputError("graph: a cluster of nodes is empty; are there duplicate nodes?")
    return sums / sizes[:, None]


def _normalise(values: np.ndarray) -> np.ndarray:
    """Return columns of mean 0 and standard deviation 1; a constant column becomes 0."""
    sd = values.std(axis=0)
    return (values - values.mean(axis=0)) / np.where(sd > 1e-12, sd, 1.0)
