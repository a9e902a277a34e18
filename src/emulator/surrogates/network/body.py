r"""Features of a ventricle for the network of a family: numbers, and vectors that turn with it.

Features are products of the body's own vectors (:mod:`emulator.geometry.heart_wall`), of its fibres
and of its linear responses to pressure (:mod:`emulator.fem.linear_response`); lengths are over the
body's size L, volumes over L^3, and responses over their own mean. So a ventricle moved, turned or
enlarged has the same features, and its displacement over L, with respect to its own vectors, is the
same too, as it is in mechanics without gravity. Features are standardised by means and deviations
of the family that the network was trained on, not of the body at hand.

Messages run between regions, parts of the wall that do not depend on how finely it is meshed: their
centres are those of a k-means clustering of the nodes, weighted by volume. A node takes a mean of
the states of the regions nearest to it, which varies continuously over the wall.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError
from emulator.fem.linear_response import RESPONSES, linear_responses, pressure_force
from emulator.geometry.discretisation import Discretisation, from_quadrature_points
from emulator.geometry.fibres import unit
from emulator.geometry.heart_wall import Ventricle, ventricle
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import NODES, corner_parents, to_linear
from emulator.scenes.scene import Scene, find_cavity
from emulator.surrogates.network.graph import (
    AugmentedGraph,
    cluster_means,
    clusters,
    hierarchy,
    nearest,
    neighbours,
)

_NEAREST = 1e-3  # least distance over L in a logarithm
_REGIONS = 256  # or a quarter of the nodes, in a small mesh
_JOINED = 6  # regions that each is joined to
_AROUND = 4  # regions whose states a node takes
_FLAGS = 2  # features of nodes, the first, whose mean over a region would depend on the mesh

VECTORS = 7 + RESPONSES
"""The number of vectors of a node of which the output is a combination."""


class BodyFeatures(NamedTuple):
    """The features of a ventricle that the network of a family reads.

    graph : the graph of the regions, its features before standardisation.
    local : the features of all nodes, (n, d).
    near, closeness : the regions nearest to each node, (n, k), and their weights, which sum to one.
    vectors : the vectors of which the output is a combination, (n, v, 3) mm.
    shares : the part of the wall's volume in each region, (c,).
    numbers : the numbers that describe the whole body, by name; they do not depend on its size.
    size : the length L, mm.
    """

    graph: AugmentedGraph
    local: np.ndarray
    near: np.ndarray
    closeness: np.ndarray
    vectors: np.ndarray
    shares: np.ndarray
    numbers: dict[str, float]
    size: float

    @property
    def shape(self) -> dict[str, float]:
        """The size and the numbers, by which a body is compared with a family's."""
        return {"size": self.size, **self.numbers}


def describe(scene: Scene) -> BodyFeatures:
    """Return the features of the ventricle of ``scene``.

    :class:`InputError` where the scene has no fibres, or not one cavity under pressure, and where
    :func:`~emulator.geometry.heart_wall.ventricle` raises it.
    """
    if scene.fibres is None:
        raise InputError(f"scene '{scene.name}' has no fibres; this network was trained with them")
    if scene.angles:
        raise InputError(
            f"scene '{scene.name}': theta turns its fibres, and this network was trained with "
            "fibres that are known; train one for the scene"
        )
    cavity, mesh, grid = find_cavity(scene).facet_set, scene.mesh, scene.discretisation
    try:
        corners, parents = _corners(mesh)
        corner_nodes = np.flatnonzero(parents[:, 0] == parents[:, 1])
        at_corners = ventricle(corners, cavity, scene.held.all(axis=1)[corner_nodes])
        fibres = scene.fibres_at_points
        responses = linear_responses(grid, fibres, cavity, scene.held)
    except InputError as error:
        raise InputError(f"scene '{scene.name}' is no ventricle to this network: {error}") from None
    body = _on_nodes(at_corners, mesh, parents, cavity, scene.held.all(axis=1))
    volume = _nodal_volumes(grid)
    sizes = np.linalg.norm(responses, axis=2) @ volume / volume.sum()
    relative = responses / sizes[:, None, None]
    strains = np.einsum("mqai,smaj->smqij", grid.gradients, relative[:, mesh.elements])
    strains = 0.5 * (strains + np.swapaxes(strains, -1, -2))
    tensors = np.concatenate([np.einsum("mqi,mqj->mqij", fibres, fibres)[None], strains])
    along, *rates = _nodal_means(grid, tensors, volume)
    local = np.column_stack(
        [
            _places(body),
            _products(body, along),
            *(_along(body, field) for field in relative),
            *(_products(body, body.size * rate)[:, :5] for rate in rates[:2]),
            *(body.size * np.einsum("nij,nij->n", along, rate) for rate in rates),
        ]
    )
    numbers = _numbers(body, grid, fibres)
    numbers |= _of_responses(mesh, cavity, body, responses, sizes)
    graph, near, closeness, shares = _regions(body, local, numbers, volume)
    return BodyFeatures(
        graph=graph,
        local=local,
        near=near,
        closeness=closeness,
        vectors=np.concatenate([body.vectors(), relative.transpose(1, 0, 2)], axis=1) * body.size,
        shares=shares,
        numbers=numbers,
        size=body.size,
    )


def _regions(
    body: Ventricle, local: np.ndarray, numbers: dict[str, float], volume: np.ndarray
) -> tuple[AugmentedGraph, np.ndarray, np.ndarray, np.ndarray]:
    """Return the graph, and the nodes' ``near``, ``closeness`` and the regions' ``shares``.

    body : with the fields of all nodes. volume : of the wall at each node, (n,).
    """
    count = min(_REGIONS, len(local) // 4)
    region = clusters(body.offset, count, volume)
    mean = partial(cluster_means, labels=region, count=count, weights=volume)
    centres = mean(body.offset)
    layers = hierarchy(centres, neighbours(centres, min(_JOINED, count - 1)))
    whole = np.tile(list(numbers.values()), (count, 1))
    nodes = layers.extend(np.column_stack([mean(local[:, _FLAGS:]), whole]))
    receivers, senders = layers.pairs.T
    places, normals = layers.extend(centres), layers.extend(mean(body.normal))
    edges = _edges(places, normals, body.axis, layers.pairs)
    near, distance = nearest(centres, body.offset, min(_AROUND + 1, count))
    # The weight of a region has come to zero where another takes its place among the nearest.
    closeness = (1.0 - distance[:, :-1] / distance[:, -1:]) ** 2
    closeness /= closeness.sum(axis=1, keepdims=True)
    graph = AugmentedGraph(nodes, edges, senders, receivers, count)
    return graph, near[:, :-1], closeness, np.bincount(region, volume) / volume.sum()


def _corners(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """Return the linear mesh of the corners, and the two corners of each node, (n, 2)."""
    if mesh.order == 1:
        return mesh, np.repeat(np.arange(len(mesh.nodes))[:, None], 2, axis=1)
    return to_linear(mesh), corner_parents(mesh)


def _on_nodes(
    body: Ventricle, mesh: Mesh, parents: np.ndarray, cavity: str, held: np.ndarray
) -> Ventricle:
    """Return ``body``, of the corners, with the fields of all nodes of ``mesh``."""
    corner = int(np.flatnonzero(parents[:, 0] == parents[:, 1])[0])
    origin = mesh.nodes[corner] - body.size * body.offset[0]
    return replace(
        body,
        offset=(mesh.nodes - origin) / body.size,
        depth=body.depth[parents].mean(axis=1),
        normal=unit(body.normal[parents].mean(axis=1)),
        inner=np.isin(np.arange(len(mesh.nodes)), mesh.facet_set(cavity)),
        held=held,
    )


def _numbers(body: Ventricle, grid: Discretisation, fibres: np.ndarray) -> dict[str, float]:
    """Return the numbers of the shape and of its fibres (m, q, 3), by volume over the wall."""
    rim = body.inner & body.held
    at_points = grid.values @ np.column_stack([body.circumference, body.depth])[grid.connectivity]
    helix = np.einsum("mqi,mqi->mq", at_points[..., :3], fibres) * (fibres @ body.axis)
    shares = grid.weights / grid.weights.sum()
    return {
        "wall over cavity": float(np.log(body.wall / body.cavity)),
        "length": float(-body.height[body.inner].min()),
        "radius": float(np.linalg.norm(body.across[rim], axis=1).mean()),
        "helix": float(np.sum(shares * helix)),
        "helix gradient": float(np.sum(shares * helix * (at_points[..., 3] - 0.5))),
        "thicker": float(np.linalg.norm(body.lean)),
    }


def _of_responses(
    mesh: Mesh, cavity: str, body: Ventricle, responses: np.ndarray, sizes: np.ndarray
) -> dict[str, float]:
    """Return the body's compliance: logarithms of mean displacements and of volumes."""
    growth = pressure_force(mesh, mesh.nodes, cavity)
    volumes = np.einsum("ni,sni->s", growth, responses) / body.size**3
    response = {"response": float(np.log(sizes[0] / body.size))}
    later = {f"response {k}": float(np.log(sizes[k] / sizes[0])) for k in range(1, RESPONSES)}
    grown = {
        f"growth {k}": float(v * body.size / size)
        for k, (v, size) in enumerate(zip(volumes, sizes, strict=True))
    }
    return response | later | grown


def _places(body: Ventricle) -> np.ndarray:
    """Return the features of the nodes' positions, (n, 12)."""
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
            np.log(np.maximum(-body.height, _NEAREST)),
        ]
    )


def _along(body: Ventricle, field: np.ndarray) -> np.ndarray:
    """Return the parts of ``field`` (n, 3) along normal, circumference and axis, (n, 3)."""
    directions = (body.normal, body.circumference, np.broadcast_to(body.axis, field.shape))
    return np.column_stack([np.einsum("ni,ni->n", direction, field) for direction in directions])


def _products(body: Ventricle, tensors: np.ndarray) -> np.ndarray:
    """Return products of symmetric ``tensors`` (n, 3, 3) with the node's vectors, (n, 6)."""
    n, c = body.normal, body.circumference
    k = np.broadcast_to(body.axis, n.shape)
    pairs = ((k, k), (n, n), (c, c), (c, k), (n, k), (n, c))
    return np.column_stack([np.einsum("ni,nij,nj->n", a, tensors, b) for a, b in pairs])


def _nodal_volumes(grid: Discretisation) -> np.ndarray:
    """Return the wall's volume at each node, (n,) mm3: equal parts of its elements'."""
    elements = grid.connectivity
    volume = np.zeros(len(grid.mesh.nodes))
    np.add.at(volume, elements, grid.weights.sum(axis=1)[:, None] / elements.shape[1])
    return volume


def _nodal_means(grid: Discretisation, tensors: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """Return the means (s, n, 3, 3), over a node's elements, of their values at the node.

    tensors : at the quadrature points, (s, m, q, 3, 3); linear in each element.
    volume : of the wall at each node, (n,) mm3.
    """
    elements = grid.connectivity
    to_nodes = from_quadrature_points(grid.mesh.order, NODES[: elements.shape[1]])
    volumes = grid.weights.sum(axis=1) / elements.shape[1]
    contributions = np.einsum("aq,m,smqij->masij", to_nodes, volumes, tensors)
    total = np.zeros((len(volume), *contributions.shape[2:]))
    np.add.at(total, elements, contributions)
    return (total / volume[:, None, None, None]).swapaxes(0, 1)


def _edges(x: np.ndarray, normals: np.ndarray, axis: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return positions from sender to receiver along n, c and k of their middle, and lengths."""
    receivers, senders = pairs.T
    relative = x[receivers] - x[senders]
    n = 0.5 * (normals[receivers] + normals[senders])
    c = np.cross(axis, n)
    length = np.linalg.norm(relative, axis=1)
    parts = [np.einsum("ei,ei->e", relative, direction) for direction in (n, c)]
    return np.column_stack([*parts, relative @ axis, length])
