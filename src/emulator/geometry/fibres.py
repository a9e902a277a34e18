r"""Fibre and sheet directions at the elements' quadrature points: from data, or by rule.

A fibre and its opposite are equal, so values are turned to one side before they are averaged, and
the average is made unit length again.

**From nodes**, by the shape functions: :math:`f(x_q) \propto \sum_a N_a(x_q)\, s_a f_a`, with the
sign :math:`s_a` of :math:`f_a \cdot f_1`.

**From elements**, a value :math:`f_e` at each centroid :math:`x_e` is continued linearly,
:math:`f(x_q) \propto f_e + G_e (x_q - x_e)`. The slope fits the elements that share a node with it
and point roughly along it,

.. math:: \min_{G_e} \sum_j w_j\, |s_j f_j - f_e - G_e (x_j - x_e)|^2 ,
          \qquad w_j = |x_j - x_e|^{-2} .

Every field is exact at the centroid and has an error of second order elsewhere (patch recovery;
Zienkiewicz & Zhu 1992).

**By rule**, the depth :math:`\tau` in the wall solves Laplace's equation, 0 on the endocardium and
1 on the epicardium. Its gradient is the transmural direction :math:`n`, the long axis :math:`k`
then gives the circumferential :math:`c = k \times n / |k \times n|`, and

.. math:: f = \cos\alpha\, c + \sin\alpha\, (n \times c), \qquad
          \alpha = \alpha_{endo} + \tau\, (\alpha_{epi} - \alpha_{endo}).

Sheets are transmural, or turned about the fibre by an angle that varies likewise,
:math:`s = \cos\beta\, n + \sin\beta\, (f \times n)`. A positive angle climbs from the circumference
towards the base when ``axis`` points there, going round anticlockwise as seen from the base: the
right-handed helix of a heart's endocardium.

Arrays are (m, 3) on linear meshes, whose elements have one quadrature point, and (m, q, 3) on
quadratic ones. The depth has the mesh's own order. On a linear mesh its gradient is averaged at the
nodes first, because an element's own gradient is one order less accurate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve

from emulator.core.errors import InputError
from emulator.geometry.discretisation import (
    Discretisation,
    discretise,
    quadrature_points,
    shapes_at,
)
from emulator.geometry.mesh import Mesh, frozen_array

# Neighbours of another direction, as across the seam of two walls, do not enter the slope.
_ALIKE = np.cos(np.radians(60.0))
_DAMPING = 1e-3  # regularises the slope along directions without neighbours


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) at length one; zero, as where depth is constant, becomes e_x."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), np.eye(3)[0])


def across(sheets: np.ndarray, fibres: np.ndarray) -> np.ndarray:
    """Return ``sheets`` (..., 3) made orthogonal to ``fibres`` (..., 3), both of length 1."""
    return unit(sheets - np.sum(sheets * fibres, axis=-1, keepdims=True) * fibres)


def of_elements(directions: np.ndarray) -> np.ndarray:
    """Return the mean direction (m, 3) of each element from (m, 3) or (m, q, 3)."""
    return directions if directions.ndim == 2 else unit(directions.mean(axis=1))


def from_nodes(mesh: Mesh, at_nodes: np.ndarray, order: int) -> np.ndarray:
    """Return unit directions (m, q, 3) at the points of elements of ``order`` from (n, 3) at nodes.

    ``order`` may be higher than the mesh's, which is about to be made quadratic.
    """
    local = at_nodes[mesh.elements]
    side = np.where(np.einsum("mai,mi->ma", local, local[:, 0]) < 0.0, -1.0, 1.0)
    values, _ = shapes_at(mesh.order, quadrature_points(order))
    return unit(np.einsum("qa,ma,mai->mqi", values, side, local))


def from_elements(mesh: Mesh, directions: np.ndarray) -> np.ndarray:
    """Interpolate one direction per element, (m, 3), at quadratic elements' points, (m, 4, 3).

    ``mesh`` is quadratic, or linear and about to be.
    """
    corners = mesh.nodes[mesh.corners]
    centre, count = corners.mean(axis=1), len(directions)
    rows = np.repeat(np.arange(count), 4)
    touching = csr_matrix((np.ones(4 * count), (rows, mesh.corners.ravel())))
    one, other = (touching @ touching.T).nonzero()
    cosine = np.sum(directions[one] * directions[other], axis=1)
    alike_pairs = (one != other) & (np.abs(cosine) > _ALIKE)
    one, other, side = one[alike_pairs], other[alike_pairs], np.sign(cosine[alike_pairs])
    step = centre[other] - centre[one]
    weight = 1.0 / np.sum(step**2, axis=1)[:, None, None]
    change = side[:, None] * directions[other] - directions[one]
    of_row = csr_matrix((np.ones(len(one)), (one, np.arange(len(one)))), (count, len(one)))
    gram, moment = (
        (of_row @ (weight * step[:, :, None] * x[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
        for x in (step, change)
    )
    damping = _DAMPING * np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-300)
    gram = gram + damping[:, None, None] * np.eye(3)
    slope = np.linalg.solve(gram, moment)  # by NumPy, because JAX's batched LAPACK is avoided
    away = np.einsum("qa,mai->mqi", quadrature_points(2), corners) - centre[:, None]
    at_points = unit(directions[:, None] + np.einsum("mqj,mji->mqi", away, slope))
    # Slopes that turn a direction by more than its neighbours differ are discarded.
    alike = np.einsum("mqi,mi->mq", at_points, directions) > _ALIKE
    return np.where(alike[:, :, None], at_points, directions[:, None])


def check_across(sheets: np.ndarray, fibres: np.ndarray) -> None:
    """Raise :class:`InputError` unless ``sheets`` are orthogonal to ``fibres``, both (m, q, 3)."""
    along = np.abs(np.einsum("mqi,mqi->mq", fibres, sheets)).max()
    if not along < 1e-6:
        raise InputError(f"sheets are not across the fibres (cosine {along:.2g})")


def checked_directions(vectors: np.ndarray, mesh: Mesh, kind: str) -> np.ndarray:
    """Return unit vectors (m, q, 3), or (m, 3), of each element of ``mesh``, frozen.

    :class:`InputError` for another shape, or no unit vectors; ``kind`` says of what.
    """
    frozen = frozen_array(vectors)
    count, points = len(mesh.elements), len(quadrature_points(mesh.order))
    if frozen.shape not in ((count, 3), (count, points, 3)):
        at_points = f" or ({count}, {points}, 3)" if points > 1 else ""
        raise InputError(f"{kind} have shape {frozen.shape}; expected ({count}, 3){at_points}")
    if not np.allclose(np.linalg.norm(frozen, axis=-1), 1.0, atol=1e-6):
        raise InputError(f"{kind} are not unit vectors")
    # Linear elements have one point each: one form, so that their fingerprints agree.
    return frozen.reshape(-1, 3) if points == 1 else frozen


Angles = tuple[float, float]
Axis = tuple[float, float, float]


class Depth(NamedTuple):
    """Depth in a wall at the quadrature points, (m,) or (m, q), or at the nodes, (n,).

    value : the depth, 0 to 1. normal : the unit normal of the wall, with a last axis of 3.
    """

    value: np.ndarray
    normal: np.ndarray


BOTH = ("lv_endocardium", "rv_endocardium", "epicardium")
"""Facet sets of the walls of two ventricles."""


def biventricular_depth(mesh: Mesh) -> Depth:
    """Return the depth in the walls of two ventricles; the left one's governs the septum.

    Three harmonic fields, each 1 on one of lv_endocardium, rv_endocardium, epicardium and 0 on
    the other two, add up to one. Where the field of lv_endocardium is the smallest of the three,
    the point lies in the right ventricle's free wall and depth runs from rv_endocardium to the
    other two surfaces; elsewhere depth runs from lv_endocardium to the other two.
    """
    left, right = (
        wall_depth(mesh, (name,), tuple(other for other in BOTH if other != name))
        for name in BOTH[:2]
    )
    touch_left, touch_right = 1.0 - left.value, 1.0 - right.value
    touch_outside = 1.0 - touch_left - touch_right
    free = touch_left < np.minimum(touch_right, touch_outside)
    return Depth(
        np.where(free, right.value, left.value),
        np.where(free[..., None], right.normal, left.normal),
    )


def wall_depth(mesh: Mesh, inside: tuple[str, ...], outside: tuple[str, ...]) -> Depth:
    """Return the harmonic depth, 0 on the facet sets ``inside`` and 1 on ``outside``."""
    low, high = (
        np.unique(np.concatenate([mesh.facet_set(name) for name in names], axis=None))
        for names in (inside, outside)
    )
    if np.isin(low, high).any():
        between = " and ".join(f"'{name}'" for name in (*inside, *outside))
        raise InputError(f"fibres: facet sets {between} have nodes in common; there is no wall")
    if mesh.order == 1:
        value, normal = nodal_depth(mesh, low, high)
        return Depth(value[mesh.elements].mean(axis=1), unit(normal[mesh.elements].mean(axis=1)))
    grid = discretise(mesh)
    at_nodes = _harmonic(grid, low, high)[mesh.elements]
    value = np.einsum("qa,ma->mq", grid.values, at_nodes)
    return Depth(value, unit(np.einsum("mqai,ma->mqi", grid.gradients, at_nodes)))


def nodal_depth(mesh: Mesh, low: np.ndarray, high: np.ndarray) -> Depth:
    """Return the harmonic function (n,) that is 0 at the nodes ``low`` and 1 at ``high``.

    Gradients are averaged at the nodes: an element's own is one order less accurate.
    """
    mesh.require_linear("the depth at its nodes")
    grid = discretise(mesh)
    value = _harmonic(grid, low, high)
    slope = np.einsum("mai,ma->mi", grid.gradients[:, 0], value[mesh.elements])
    at_nodes = np.zeros((len(mesh.nodes), 3))
    np.add.at(at_nodes, mesh.elements, (grid.weights * slope)[:, None])
    return Depth(value, unit(at_nodes))


def _harmonic(grid: Discretisation, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the harmonic function (n,) that is 0 at the nodes ``low`` and 1 at ``high``."""
    stiffness, count = grid.laplacian(), len(grid.mesh.nodes)
    value = np.zeros(count)
    value[high] = 1.0
    free = np.setdiff1d(np.arange(count), np.union1d(low, high))
    if len(free):  # in a wall of one linear layer every node is on a surface
        value[free] = spsolve(stiffness[free][:, free], -(stiffness[free] @ value))
    return value


def turned(
    wall: Depth, angles: Angles, axis: Axis, sheet_angles: Angles = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return unit fibres and sheets in a wall of known depth, by the rule in the module docstring.

    angles, sheet_angles : degrees on the endocardium and on the epicardium.
    axis : from apex to base, any length.
    """
    k = np.asarray(axis, dtype=float)
    if k.shape != (3,) or not np.isfinite(k).all() or not k.any():
        raise InputError(f"fibres: axis {axis}; expected three numbers, not all zero")
    for pair in (angles, sheet_angles):
        if len(pair) != 2 or not np.isfinite(pair).all():
            raise InputError(f"fibres: angles {pair}; expected two numbers in degrees")
    n, c = wall.normal, circumferential(wall.normal, k / np.linalg.norm(k))
    (alpha, to_alpha), (beta, to_beta) = np.radians(angles), np.radians(sheet_angles)
    depth = wall.value[..., None]
    alpha, beta = alpha + depth * (to_alpha - alpha), beta + depth * (to_beta - beta)
    f = np.cos(alpha) * c + np.sin(alpha) * np.cross(n, c)
    return f, np.cos(beta) * n + np.sin(beta) * np.cross(f, n)


def circumferential(normals: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return unit vectors (..., 3) around the unit ``axis`` (3,), across ``normals`` (..., 3).

    Where a normal is along the axis, as at the apex, an arbitrary direction across it.
    """
    across = np.cross(axis, normals)
    on_axis = np.linalg.norm(across, axis=-1, keepdims=True) < 1e-8
    any_way = np.cross(normals, np.eye(3)[np.argmin(np.abs(axis))])
    return unit(np.where(on_axis, any_way, across))
