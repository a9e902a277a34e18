r"""Fibre directions by rule, at the elements' centroids.

The depth :math:`\tau` in the wall solves Laplace's equation, 0 on the endocardium and 1 on the
epicardium. Its gradient is the transmural direction :math:`n`, the long axis :math:`k` then gives
the circumferential :math:`c = k \times n / |k \times n|`, and

.. math:: f = \cos\alpha\, c + \sin\alpha\, (n \times c), \qquad
          \alpha = \alpha_{endo} + \tau\, (\alpha_{epi} - \alpha_{endo}).

A positive angle climbs from the circumference towards the base when ``axis`` points there, going
round anticlockwise as seen from the base: the right-handed helix of a heart's endocardium.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from skfem import Basis, ElementTetP1, MeshTet, condense, solve
from skfem.models.poisson import laplace

from emulator.errors import InputError
from emulator.geometry.mesh import Mesh

Angles = tuple[float, float]
Axis = tuple[float, float, float]


class Directions(NamedTuple):
    """Unit vectors (m, 3) at the elements' centroids, orthogonal to one another."""

    fibres: np.ndarray
    sheets: np.ndarray


class Depth(NamedTuple):
    """Depth in a wall at the elements' centroids: ``value`` (m,), ``normal`` (m, 3) of length 1."""

    value: np.ndarray
    normal: np.ndarray


def rule_based_directions(
    mesh: Mesh,
    endocardium: str = "endocardium",
    epicardium: str = "epicardium",
    angles: Angles = (90.0, -90.0),
    axis: Axis = (0.0, 0.0, 1.0),
) -> Directions:
    """Fibres, and sheets along the transmural direction.

    Parameters
    ----------
    mesh : any ventricle, linear or quadratic.
    endocardium, epicardium : facet sets.
    angles : helix angle in degrees on the endocardium and on the epicardium.
    axis : from apex to base, any length.
    """
    return turned(depth(mesh, (endocardium,), (epicardium,)), angles, axis)


def rule_based_fibres(
    mesh: Mesh,
    endocardium: str = "endocardium",
    epicardium: str = "epicardium",
    angles: Angles = (90.0, -90.0),
    axis: Axis = (0.0, 0.0, 1.0),
) -> np.ndarray:
    """The fibres (m, 3) of :func:`rule_based_directions`."""
    return rule_based_directions(mesh, endocardium, epicardium, angles, axis).fibres


def biventricular_directions(
    mesh: Mesh, angles: Angles = (90.0, -90.0), axis: Axis = (0.0, 0.0, 1.0)
) -> Directions:
    """The rule for two ventricles; the left one's governs the septum.

    Three harmonic fields, each 1 on one of lv_endocardium, rv_endocardium, epicardium and 0 on
    the other two, add up to one. Where the field of lv_endocardium is the smallest of the three,
    the element lies in the right ventricle's free wall and depth runs from rv_endocardium to the
    other two surfaces; elsewhere depth runs from lv_endocardium to the other two.
    The directions jump where the walls meet.
    """
    surfaces = ("lv_endocardium", "rv_endocardium", "epicardium")
    left, right = (
        depth(mesh, (name,), tuple(other for other in surfaces if other != name))
        for name in surfaces[:2]
    )
    touch_left, touch_right = 1.0 - left.value, 1.0 - right.value
    touch_outside = 1.0 - touch_left - touch_right
    free = touch_left < np.minimum(touch_right, touch_outside)
    wall = Depth(
        np.where(free, right.value, left.value),
        np.where(free[:, None], right.normal, left.normal),
    )
    return turned(wall, angles, axis)


def depth(mesh: Mesh, inside: tuple[str, ...], outside: tuple[str, ...]) -> Depth:
    """Harmonic depth, 0 on the facet sets ``inside`` and 1 on ``outside``."""
    low, high = _nodes(mesh, inside), _nodes(mesh, outside)
    if np.isin(low, high).any():
        between = " and ".join(f"'{name}'" for name in (*inside, *outside))
        raise InputError(f"fibres: facet sets {between} have nodes in common; there is no wall")
    _, elements, value, normals = nodal_depth(mesh, low, high)
    return Depth(value[elements].mean(axis=1), _unit(normals[elements].mean(axis=1)))


class NodalDepth(NamedTuple):
    """Depth in a wall at the k corner nodes of a mesh.

    corners : (k,) the nodes. elements : (m, 4) rows of ``corners``.
    value : (k,) from 0 to 1. normal : (k, 3) of length 1.
    """

    corners: np.ndarray
    elements: np.ndarray
    value: np.ndarray
    normal: np.ndarray


def nodal_depth(mesh: Mesh, low: np.ndarray, high: np.ndarray) -> NodalDepth:
    """The harmonic function that is 0 at the corner nodes ``low`` and 1 at ``high``.

    Gradients are averaged at the nodes: an element's own is one order less accurate.
    """
    # Corner nodes alone: a quadratic mesh gives the same directions as the linear one it came from.
    corners, elements = np.unique(mesh.elements[:, :4], return_inverse=True)
    elements = elements.reshape(-1, 4)
    basis = Basis(
        MeshTet(mesh.nodes[corners].T.copy(), elements.T.copy(), sort_t=False), ElementTetP1()
    )
    low, high = (np.searchsorted(corners, nodes) for nodes in (low, high))
    value = basis.zeros()
    value[high] = 1.0
    value = solve(*condense(laplace.assemble(basis), x=value, D=np.union1d(low, high)))
    slope = basis.interpolate(value).grad[:, :, 0].T  # (m, 3), constant in an element
    volumes = basis.dx.sum(axis=1)
    at_nodes = np.zeros((len(corners), 3))
    np.add.at(at_nodes, elements, (volumes[:, None] * slope)[:, None])
    return NodalDepth(corners, elements, value, _unit(at_nodes))


def turned(wall: Depth, angles: Angles, axis: Axis) -> Directions:
    """Directions in a wall of known depth, by the rule in the module docstring.

    The axis may have any length.
    """
    k = np.asarray(axis, dtype=float)
    if k.shape != (3,) or not np.isfinite(k).all() or not k.any():
        raise InputError(f"fibres: axis {axis}; expected three numbers, not all zero")
    if len(angles) != 2 or not np.isfinite(angles).all():
        raise InputError(f"fibres: angles {angles}; expected two numbers in degrees")
    n, c = wall.normal, circumferential(wall.normal, k / np.linalg.norm(k))
    first, last = np.radians(angles)
    alpha = (first + wall.value * (last - first))[:, None]
    return Directions(np.cos(alpha) * c + np.sin(alpha) * np.cross(n, c), n)


def circumferential(normals: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Unit vectors (m, 3) around ``axis`` (3,) of length 1, across the ``normals`` (m, 3).

    Where a normal is along the axis, as at the apex, an arbitrary direction across it.
    """
    across = np.cross(axis, normals)
    on_axis = np.linalg.norm(across, axis=1) < 1e-8
    any_way = np.cross(normals, np.eye(3)[np.argmin(np.abs(axis))])
    return _unit(np.where(on_axis[:, None], any_way, across))


def _nodes(mesh: Mesh, names: tuple[str, ...]) -> np.ndarray:
    """Corner nodes of facet sets."""
    return np.unique(np.concatenate([mesh.facet_set(name)[:, :3] for name in names]))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (k, 3) at length one; a zero vector, as where depth is constant, becomes e_x."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), np.eye(3)[0])
