r"""Unit directions at an element's quadrature points, from its nodes or from one value an element.

A fibre and its opposite are equal, so values are turned to one side before they are averaged, and
the average is made unit length again.

* **From nodes**, by the shape functions: :math:`f(x_q) \propto \sum_a N_a(x_q)\, s_a f_a`,
  with the sign :math:`s_a` of :math:`f_a \cdot f_1`.
* **From elements**: a value :math:`f_e` at each centroid :math:`x_e` is continued linearly,
  :math:`f(x_q) \propto f_e + G_e (x_q - x_e)`. The slope fits the elements that share a node with
  it and point roughly along it,

  .. math:: \min_{G_e} \sum_j w_j\, |s_j f_j - f_e - G_e (x_j - x_e)|^2 ,
            \qquad w_j = |x_j - x_e|^{-2} .

  At the centroid every field comes out exactly, elsewhere with an error of second order (patch
  recovery; Zienkiewicz & Zhu 1992).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from emulator.core.errors import InputError
from emulator.geometry.discretisation import quadrature_points, shapes_at
from emulator.geometry.mesh import Mesh, frozen_array

# Neighbours further off in direction, as across the seam of two walls, say nothing of the slope.
_ALIKE = np.cos(np.radians(60.0))
_DAMPING = 1e-3  # of the slope along a direction in which an element has no neighbours


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at length one; a zero vector, as where depth is constant, becomes e_x."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), np.eye(3)[0])


def across(sheets: np.ndarray, fibres: np.ndarray) -> np.ndarray:
    """``sheets`` (..., 3) turned to be orthogonal to ``fibres`` (..., 3), both of length 1."""
    return unit(sheets - np.sum(sheets * fibres, axis=-1, keepdims=True) * fibres)


def of_elements(directions: np.ndarray) -> np.ndarray:
    """Mean direction (m, 3) of each element from (m, 3) or (m, q, 3)."""
    return directions if directions.ndim == 2 else unit(directions.mean(axis=1))


def from_nodes(mesh: Mesh, at_nodes: np.ndarray, order: int) -> np.ndarray:
    """Unit directions at the quadrature points of elements of ``order``, (m, q, 3).

    Parameters
    ----------
    mesh : linear or quadratic; ``order`` may be higher, for a mesh that is made quadratic.
    at_nodes : (n, 3) of its nodes.
    """
    local = at_nodes[mesh.elements]
    side = np.where(np.einsum("mai,mi->ma", local, local[:, 0]) < 0.0, -1.0, 1.0)
    values, _ = shapes_at(mesh.order, quadrature_points(order))
    return unit(np.einsum("qa,ma,mai->mqi", values, side, local))


def from_elements(mesh: Mesh, given: np.ndarray) -> np.ndarray:
    """Unit directions at the quadrature points of quadratic elements, (m, 4, 3), from (m, 3).

    ``mesh`` is quadratic, or linear and about to be.
    """
    corners = mesh.nodes[mesh.corners]
    centre, count = corners.mean(axis=1), len(given)
    rows = np.repeat(np.arange(count), 4)
    touching = csr_matrix((np.ones(4 * count), (rows, mesh.corners.ravel())))
    one, other = (touching @ touching.T).nonzero()
    cosine = np.sum(given[one] * given[other], axis=1)
    kept = (one != other) & (np.abs(cosine) > _ALIKE)
    one, other, side = one[kept], other[kept], np.sign(cosine[kept])
    step = centre[other] - centre[one]
    weight = 1.0 / np.sum(step**2, axis=1)
    change = side[:, None] * given[other] - given[one]
    gram = _summed(one, weight[:, None, None] * step[:, :, None] * step[:, None, :], count)
    moment = _summed(one, weight[:, None, None] * step[:, :, None] * change[:, None, :], count)
    damping = _DAMPING * np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-300)
    gram = gram + damping[:, None, None] * np.eye(3)
    slope = np.linalg.solve(gram, moment)  # NumPy, no batched LAPACK of JAX's
    away = np.einsum("qa,mai->mqi", quadrature_points(2), corners) - centre[:, None]
    found = unit(given[:, None] + np.einsum("mqj,mji->mqi", away, slope))
    # A slope that would turn a direction by more than its neighbours differ is not believed.
    alike = np.einsum("mqi,mi->mq", found, given) > _ALIKE
    return np.where(alike[:, :, None], found, given[:, None])


def _summed(rows: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums (count, 3, 3) of ``values`` (k, 3, 3) by row."""
    flat = values.reshape(len(values), 9)
    return np.stack([np.bincount(rows, each, count) for each in flat.T], axis=1).reshape(-1, 3, 3)


def check_across(sheets: np.ndarray, fibres: np.ndarray) -> None:
    """:class:`InputError` unless ``sheets`` (m, q, 3) are orthogonal to ``fibres`` (m, q, 3)."""
    along = np.abs(np.einsum("mqi,mqi->mq", fibres, sheets)).max()
    if not along < 1e-6:
        raise InputError(f"sheets are not across the fibres (cosine {along:.2g})")


def checked_directions(vectors: np.ndarray, mesh: Mesh, kind: str) -> np.ndarray:
    """Unit vectors (m, q, 3), or (m, 3), of each element of ``mesh``, frozen.

    Raises
    ------
    InputError
        Another shape, or no unit vectors; ``kind`` says of what.
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
