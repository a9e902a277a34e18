r"""Shape functions and quadrature of a mesh, and how well shaped its elements are for them.

Shape functions are tabulated once from scikit-fem's reference elements. Quadrature points lie in
blocks: elements, or patches of linear elements that share a volume change.

The dihedral angle between two faces with outward normals :math:`n_i, n_j` is
:math:`\pi - \arccos(n_i \cdot n_j)`, 70.5 degrees in a regular tetrahedron. Small ones make the
stiffness matrix ill-conditioned, large ones (near 180) make gradients wrong: flat elements have
both. A curved element's Jacobian varies; where it nearly vanishes, the element nearly folds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.sparse import csc_matrix
from skfem import ElementTetP1, ElementTetP2, ElementTriP1, ElementTriP2
from skfem.quadrature import get_quadrature

from emulator.core.errors import InputError
from emulator.geometry.mesh import Mesh, cross_sides, faces_of, frozen_array, parts

_SIZE = 6  # tetrahedra in a patch; the cavity of a ventricle grows as much with 8 or 12
_LEAST = 3  # least elements of a patch; smaller remainders join a neighbour


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

    The rule integrates the small-strain stiffness of a straight element exactly. The geometry is
    interpolated by the same shape functions, so a quadratic mesh may be curved;
    :class:`InputError` for an element that folds over itself at a quadrature point.
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
    """Return shape functions (d, a) at ``barycentric`` (d, 4), and their derivatives (d, a, 3).

    These are in the last three coordinates.
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


@dataclass(frozen=True, eq=False)
class Patches(Blocks):
    r"""Patches of neighbouring linear tetrahedra that share one volume change, a point for each.

    A mesh has five or six tetrahedra a node. Nearly incompressible, each is a constraint on volume,
    and three displacements a node cannot meet them all: linear elements lock. With patches
    :math:`P` of about six, which do not overlap,

    .. math::
        \hat F_e = \left(\bar J_P / J_e\right)^{1/3} F_e, \qquad
        \bar J_P = \frac{\sum_{e \in P} V_e J_e}{\sum_{e \in P} V_e},

    there is about one constraint a node (de Souza Neto, Andrade Pires & Owen 2005, Int. J. Numer.
    Meth. Engng 62, 353-383). Here W at :math:`\hat F` is one energy, as with mean dilatation.

    Patches smaller than the largest repeat a node with gradients of zero, and a tetrahedron with a
    weight of zero.

    members : the element (b, q) at each point.
    """

    members: np.ndarray

    def gather[A: (jax.Array, np.ndarray)](self, field: A) -> A:
        """Return the values (b, q, ...) at the patches' points of a ``field`` (m, 1, ...)."""
        return field[self.members, 0]


def patchwise(grid: Discretisation) -> Patches:
    """Return the linear elements of ``grid`` in :func:`patches`."""
    label = patches(grid.mesh)
    members, real = _rows(label, np.arange(len(label)))
    keys, columns = np.unique(
        label[:, None] * len(grid.mesh.nodes) + grid.connectivity, return_inverse=True
    )
    owner, node = np.divmod(keys, len(grid.mesh.nodes))
    connectivity, _ = _rows(owner, node)
    column = np.arange(len(keys)) - np.searchsorted(owner, owner)
    # Each element's gradients at the columns of its patch.
    wide = np.zeros((len(label), connectivity.shape[1], 3))
    wide[np.arange(len(label))[:, None], column[columns.reshape(-1, 4)]] = grid.gradients[:, 0]
    return Patches(
        connectivity=frozen_array(connectivity, int),
        gradients=frozen_array(wide[members]),
        weights=frozen_array(np.where(real, grid.weights[members, 0], 0.0)),
        members=frozen_array(members, int),
    )


def _rows(label: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of each label as a row, filled with its first, and which are no fill."""
    order = np.argsort(label, kind="stable")
    counts = np.bincount(label)
    first = np.cumsum(counts) - counts
    column = np.arange(counts.max())
    real = column < counts[:, None]
    return values[order[first[:, None] + np.where(real, column, 0)]], real


def patches(mesh: Mesh) -> np.ndarray:
    """Return the patch of each linear tetrahedron, (m,) from 0 up.

    A patch grows from the first tetrahedron that is in none, over faces, to six; small remainders
    join their smallest neighbour, because isolated elements would lock. Patches depend on the
    mesh's connections only, not on the order in which its elements are listed.
    """
    corners = np.sort(mesh.corners, axis=1)
    order = np.lexsort(corners.T)
    neighbours = _neighbours(corners[order])
    groups = _join_small(_grow(corners[order].tolist(), neighbours), neighbours)
    label = np.empty(len(order), dtype=int)
    for k, group in enumerate(groups):
        label[order[group]] = k
    return label


def _neighbours(corners: np.ndarray) -> list[list[int]]:
    """Return the elements across the faces of each element, from sorted ``corners`` (m, 4)."""
    faces = np.sort(faces_of(corners), axis=1)
    order = np.lexsort(faces.T)
    same = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(axis=1))
    neighbours: list[list[int]] = [[] for _ in corners]
    ends = np.stack([order[same], order[same + 1]]) % len(corners)
    for one, other in ends.T.tolist():
        neighbours[one].append(other)
        neighbours[other].append(one)
    return neighbours


def _grow(corners: Sequence[list[int]], neighbours: Sequence[list[int]]) -> list[list[int]]:
    """Return the elements of each patch, grown over faces to at most ``_SIZE``."""
    assigned, groups = [False] * len(corners), []

    def order(k: int, nodes: set[int]) -> tuple[int, int, int]:
        # Prefer compact patches, then elements with few free neighbours.
        return len(nodes.union(corners[k])), sum(not assigned[j] for j in neighbours[k]), k

    for seed in range(len(corners)):
        group: list[int] = []
        nodes: set[int] = set()
        edge = set() if assigned[seed] else {seed}
        while edge and len(group) < _SIZE:
            best = min(edge, key=lambda k: order(k, nodes))
            group.append(best)
            assigned[best] = True
            nodes.update(corners[best])
            edge = {k for k in edge.union(neighbours[best]) if not assigned[k]}
        if group:
            groups.append(group)
    return groups


def _join_small(groups: list[list[int]], neighbours: Sequence[list[int]]) -> list[list[int]]:
    """Join each patch below ``_LEAST`` elements to its smallest neighbour; return the patches."""
    owner = {k: patch for patch, group in enumerate(groups) for k in group}
    for patch, group in enumerate(groups):
        adjacent = {owner[j] for k in group for j in neighbours[k]} - {patch}
        if len(group) < _LEAST and adjacent:
            neighbour = min(adjacent, key=lambda other: (len(groups[other]), other))
            groups[neighbour] += group
            owner |= dict.fromkeys(group, neighbour)
            groups[patch] = []
    return [group for group in groups if group]


FLAT = 3.0
"""Degrees; elements with a smaller dihedral angle are worth a word."""


class MeshQuality(NamedTuple):
    """Shapes of a mesh's elements.

    parts : the number of disconnected parts.
    angle : the least dihedral angle, degrees. flat : the number of elements below :data:`FLAT`.
    place : mm, middle of the element with the smallest angle.
    jacobian : least ratio of an element's smallest Jacobian to its mean, at quadrature points; 1
        where elements are straight.
    """

    parts: int
    angle: float
    flat: int
    place: tuple[float, float, float]
    jacobian: float

    def sentence(self) -> str:
        """Return all numbers of the quality in one line."""
        place = ", ".join(f"{x:.4g}" for x in self.place)
        pieces = "1 part" if self.parts == 1 else f"{self.parts} parts"
        text = f"{pieces}; smallest dihedral angle {self.angle:.3g} degrees, at ({place})"
        if self.flat:
            text += f", {self.flat} element{'s' * (self.flat > 1)} below {FLAT:g}: remesh there"
        if self.jacobian < 1.0:
            text += f"; least Jacobian {self.jacobian:.2f} of its element's mean"
        return text


def mesh_quality(mesh: Mesh) -> MeshQuality:
    """Return the quality of a mesh from its corners and, where curved, its quadrature points."""
    angles = dihedral_angles(mesh)
    smallest = angles.min(axis=1)
    worst = int(np.argmin(smallest))
    weights = discretise(mesh).weights
    ratio = float((weights.min(axis=1) / weights.mean(axis=1)).min())
    return MeshQuality(
        parts=int(parts(mesh.elements, len(mesh.nodes)).max()) + 1,
        angle=float(smallest[worst]),
        flat=int((smallest < FLAT).sum()),
        place=tuple(mesh.nodes[mesh.elements[worst, :4]].mean(axis=0).tolist()),
        jacobian=min(round(ratio, 12), 1.0),
    )


def dihedral_angles(mesh: Mesh) -> np.ndarray:
    """Return the six dihedral angles of each element, by its corners, (m, 6) degrees."""
    normals = cross_sides(mesh.nodes[faces_of(mesh.corners)])
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).reshape(4, -1, 3)
    cosines = [np.einsum("mi,mi->m", one, other) for one, other in combinations(normals, 2)]
    return 180.0 - np.degrees(np.arccos(np.clip(np.stack(cosines, axis=1), -1.0, 1.0)))
