"""What generators share: default sizes, named surfaces, triangulations extruded to tetrahedra."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, boundary_facets, orient
from emulator.geometry.refinement import Midpoints, to_quadratic


def body(
    nodes: np.ndarray,
    elements: np.ndarray,
    surfaces: Mapping[str, np.ndarray],
    node_sets: Mapping[str, np.ndarray],
    midpoints: Midpoints | None,
    order: int,
) -> Mesh:
    """Return the mesh of a body, linear or quadratic by ``order``, its elements oriented.

    nodes, elements : (n, 3) mm and (m, 4), any orientation.
    surfaces : name -> nodes; a surface triangle belongs to the set that has its three corners.
    midpoints : positions of the mid-edge nodes; ``None`` for straight edges.
    """
    if order not in (1, 2):
        raise InputError(f"mesh: order {order}; expected 1 or 2")
    elements = orient(nodes, elements)
    surface = boundary_facets(elements)
    facets = {name: surface[np.isin(surface, on).all(axis=1)] for name, on in surfaces.items()}
    mesh = Mesh(nodes, elements, node_sets, facets)
    return mesh if order == 1 else to_quadratic(mesh, midpoints)


def extrude(columns: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return three tetrahedra, not oriented, for each prism of ``triangles`` (k, 3) in a layer.

    A prism's corners are taken in the order of their 2D numbers, so the two prisms that share a
    side cut it along the same diagonal: from the lower number below to the higher number above.

    columns : (v, layers + 1) 3D node at each 2D vertex and layer.
    """
    lower, upper = columns[:, :-1], columns[:, 1:]
    a, b, c = np.sort(triangles, axis=1).T
    tetrahedra = (
        (lower[a], lower[b], lower[c], upper[c]),
        (lower[a], lower[b], upper[b], upper[c]),
        (lower[a], upper[a], upper[b], upper[c]),
    )
    return np.stack([np.stack(corners, axis=-1) for corners in tetrahedra]).reshape(-1, 4)


def stacked(vertices: int, layers: int) -> np.ndarray:
    """Return columns (vertices, layers + 1) of nodes numbered layer by layer."""
    return np.arange(vertices * (layers + 1)).reshape(layers + 1, vertices).T


def resolved(sizes: Mapping[int, Mapping[str, Any]], order: int, **chosen: Any) -> dict[str, Any]:
    """Return sizes by name, and ``order``, with defaults in place of None.

    Quadratic elements, the default, are accurate with fewer nodes; published
    models have linear ones.

    Parameters
    ----------
    sizes : default sizes by the order of the elements, 1 and 2.
    order : order of the elements.
    chosen : the sizes by name, None for the default.
    """
    if order not in sizes:
        raise InputError(f"order {order} of the elements; expected 1 (linear) or 2 (quadratic)")
    defaults = sizes[order]
    return {
        **{name: defaults[name] if value is None else value for name, value in chosen.items()},
        "order": order,
    }
