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


@dataclass(frozen=True)
class GraphOptions:
    """Shape of the virtual layers.

    cluster : the mean number of nodes of a layer for each node of the layer above it.
    smallest : the least number of nodes of a layer; the last layer is joined completely.
    neighbours : the number kappa of nearest neighbours that each virtual node is joined to.
    """

    cluster: int = 4
    smallest: int = 8
    neighbours: int = 4


def augment(scene: Scene, options: GraphOptions = GraphOptions()) -> AugmentedGraph:
    """Return the augmented graph of a scene's mesh; equal for equal scenes."""
    layers = hierarchy(scene.mesh.nodes, mesh_edges(scene.mesh.elements), options)
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


def hierarchy(
    positions: np.ndarray, edges: np.ndarray, options: GraphOptions = GraphOptions()
) -> Hierarchy:
    """Return virtual layers above the nodes at ``positions`` (n, 3), joined by ``edges`` (e, 2)."""
    from sklearn.cluster import KMeans  # slow to import; a cached emulator needs no graph

    layer_edges, parents, offset = [edges], [], 0
    while len(positions) // options.cluster >= options.smallest:
        count = len(positions) // options.cluster
        parent = KMeans(count, n_init=1, random_state=0).fit(positions).labels_
        parents.append(parent)
        above = offset + len(positions)
        layer_edges.append(np.column_stack([offset + np.arange(len(positions)), above + parent]))
        positions = _cluster_means(positions, parent, count)
        last = count // options.cluster < options.smallest
        if last:
            layer_edges.append(above + np.column_stack(np.triu_indices(count, 1)))
        else:
            layer_edges.append(above + _nearest(positions, options.neighbours))
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


def _nearest(positions: np.ndarray, neighbours: int) -> np.ndarray:
    from sklearn.neighbors import NearestNeighbors

    count = min(neighbours, len(positions) - 1) + 1
    _, index = NearestNeighbors(n_neighbors=count).fit(positions).kneighbors(positions)
    return np.column_stack([np.repeat(index[:, 0], count - 1), index[:, 1:].ravel()])


def _normalise(values: np.ndarray) -> np.ndarray:
    """Return columns of mean 0 and standard deviation 1; a constant column becomes 0."""
    sd = values.std(axis=0)
    return (values - values.mean(axis=0)) / np.where(sd > 1e-12, sd, 1.0)
