"""Shape functions and quadrature of a mesh, tabulated once from scikit-fem's reference elements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from scipy.sparse import csc_matrix
from skfem import ElementTetP1, ElementTetP2, ElementTriP1, ElementTriP2
from skfem.quadrature import get_quadrature

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, frozen_array


@dataclass(frozen=True, eq=False)
class Blocks:
    """Groups of quadrature points that share nodes; ``b`` blocks, ``q`` points, ``a`` nodes each.

    connectivity : the node (b, a) of each local shape function.
    gradients : the reference gradients (b, q, a, 3) of the shape functions, 1/mm.
    weights : the quadrature weights (b, q) times volume, mm3.
    """

    connectivity: np.ndarray
    gradients: np.ndarray
    weights: np.ndarray

    def gather[A: (jax.Array, np.ndarray)](self, field: A) -> A:
        """Return a ``field`` (m, q, ...) of the elements at the blocks' points, (b, q, ...)."""
        return field


@dataclass(frozen=True, eq=False)
class Discretisation(Blocks):
    """A mesh with its shape functions; each of its ``m`` elements is a block.

    mesh : linear or quadratic tetrahedra.
    values : the shape functions (q, a) at the quadrature points.
    """

    mesh: Mesh
    values: np.ndarray

    def laplacian(self) -> csc_matrix:
        """The integrals (n, n) in mm of the products of the shape functions' gradients."""
        nodes, count = self.connectivity, len(self.mesh.nodes)
        local = np.einsum("mq,mqai,mqbi->mab", self.weights, self.gradients, self.gradients)
        rows, columns = np.broadcast_arrays(nodes[:, :, None], nodes[:, None])
        return csc_matrix((local.ravel(), (rows.ravel(), columns.ravel())), (count, count))


@dataclass(frozen=True, eq=False)
class FacetRule:
    """Quadrature on a reference triangle; ``q`` points, ``a`` nodes of the facet.

    values : the shape functions, (q, a).
    derivatives : (q, a, 2) derivatives of the shape functions along the two reference directions.
    weights : (q,) summing to 1/2, the reference triangle's area.
    """

    values: np.ndarray
    derivatives: np.ndarray
    weights: np.ndarray


def discretise(mesh: Mesh) -> Discretisation:
    """Return the discretisation: one quadrature point in linear elements, four in quadratic ones.

    The rule integrates the small-strain stiffness of a straight element exactly.

    The geometry is interpolated by the same shape functions, so a quadratic mesh may be curved.

    Raises
    ------
    InputError
        A curved element that folds over itself at a quadrature point.
    """
    element, points, weights = _rule(mesh.order)
    values, slopes = _tabulate(element, points)
    jacobian = np.einsum("mai,qaj->mqij", mesh.nodes[mesh.elements], slopes)
    determinant = np.linalg.det(jacobian)
    if not (determinant > 0.0).all():
        folded = int(np.flatnonzero(~(determinant > 0.0).all(axis=1))[0])
        raise InputError(f"mesh: element {folded} is curved so much that it folds over itself")
    return Discretisation(
        mesh=mesh,
        connectivity=mesh.elements,
        gradients=frozen_array(np.einsum("qaj,mqji->mqai", slopes, np.linalg.inv(jacobian))),
        values=frozen_array(values),
        weights=frozen_array(determinant * weights),
    )


def quadrature_points(order: int) -> np.ndarray:
    """Return barycentric coordinates (q, 4) of the quadrature points of elements of ``order``."""
    _, points, _ = _rule(order)
    return np.column_stack([1.0 - points.sum(axis=0), *points])


def from_quadrature_points(order: int, barycentric: np.ndarray) -> np.ndarray:
    r"""Return weights (d, q) from values at quadrature points to values at ``barycentric`` (d, 4).

    The field is linear in an element: its corner values :math:`c` and its values at the points,
    whose barycentric coordinates are the rows of :math:`B`, are related by :math:`v = B c`, so that
    :math:`\lambda \cdot c = \lambda B^+ v`. With one point it is constant.
    """
    return np.asarray(barycentric) @ np.linalg.pinv(quadrature_points(order))


def shapes_at(order: int, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shape functions (d, a) at ``barycentric`` (d, 4), and their derivatives.

    These are (d, a, 3), in the last three coordinates.
    """
    return _tabulate(_rule(order)[0], np.asarray(barycentric)[:, 1:].T)


def facet_rule(order: int, degree: int) -> FacetRule:
    """Return quadrature exact for polynomials of ``degree`` on facets with 3 or 6 nodes."""
    element = ElementTriP1() if order == 1 else ElementTriP2()
    points, weights = get_quadrature(element.refdom, degree)
    values, slopes = _tabulate(element, points)
    return FacetRule(frozen_array(values), frozen_array(slopes), frozen_array(weights))


def _rule(order: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Return the reference element, quadrature points (3, q) and their weights (q,)."""
    element, degree = (ElementTetP1(), 1) if order == 1 else (ElementTetP2(), 2)
    return element, *get_quadrature(element.refdom, degree)


def _tabulate(element: Any, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shape functions (q, a) and their derivatives (q, a, d) at ``points`` (d, q)."""
    count = len(element.doflocs)
    shapes = [element.lbasis(points, k) for k in range(count)]
    values = np.stack([np.broadcast_to(value, points.shape[1]) for value, _ in shapes], axis=1)
    slopes = np.stack([np.broadcast_to(slope, points.shape) for _, slope in shapes])
    return values, slopes.transpose(2, 0, 1)
