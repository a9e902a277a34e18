"""Shared by the generators: oriented elements, named surfaces, straight or curved edges."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh
from emulator.geometry.quadratic import Midpoints, to_quadratic
from emulator.geometry.tetrahedra import boundary_facets, orient


def body(
    nodes: np.ndarray,
    elements: np.ndarray,
    surfaces: Mapping[str, np.ndarray],
    node_sets: Mapping[str, np.ndarray],
    midpoints: Midpoints | None,
    order: int,
) -> Mesh:
    """The mesh of a body, its elements oriented.

    Parameters
    ----------
    nodes, elements : (n, 3) mm and (m, 4), any orientation.
    surfaces : name -> nodes; a surface triangle belongs to the set that has its three corners.
    node_sets : name -> nodes.
    midpoints : positions of the mid-edge nodes; ``None`` for straight edges.
    order : 1 for linear, 2 for quadratic tetrahedra.
    """
    if order not in (1, 2):
        raise InputError(f"mesh: order {order}; expected 1 or 2")
    elements = orient(nodes, elements)
    surface = boundary_facets(elements)
    facets = {name: surface[np.isin(surface, on).all(axis=1)] for name, on in surfaces.items()}
    mesh = Mesh(nodes, elements, node_sets, facets)
    return mesh if order == 1 else to_quadratic(mesh, midpoints)
