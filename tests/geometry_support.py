"""What every generated body must satisfy, and independent measures of it."""

import numpy as np
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTet

from emulator.geometry.mesh import signed_volumes

_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
_EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def jacobians(mesh):
    """Determinant (m, q) of the element map at quadrature points, and the weights (q,)."""
    points, weights = get_quadrature(RefTet, 6)
    barycentric = np.vstack([1.0 - points.sum(axis=0), points])  # (4, q)
    slopes = np.vstack([-np.ones(3), np.eye(3)])  # (4, 3)
    if mesh.elements.shape[1] == 4:
        gradients = np.repeat(slopes[:, None], len(weights), axis=1)
    else:
        corner = (4.0 * barycentric - 1.0)[:, :, None] * slopes[:, None]
        middle = [
            4.0 * (barycentric[a][:, None] * slopes[b] + barycentric[b][:, None] * slopes[a])
            for a, b in _EDGES
        ]
        gradients = np.concatenate([corner, np.stack(middle)])
    F = np.einsum("mai,aqj->mqij", mesh.nodes[mesh.elements], gradients)
    return np.linalg.det(F), weights


def volume(mesh):
    """Volume in mm3, curved edges included."""
    J, weights = jacobians(mesh)
    return float((J @ weights).sum())


def assert_sound(mesh, patches=()):
    """Positive volumes, a conforming mesh, a closed surface that the facet sets divide up.

    ``patches`` are facet sets that lie within another.
    """
    assert jacobians(mesh)[0].min() > 0.0
    corners = mesh.elements[:, :4]
    assert signed_volumes(mesh.nodes, corners).min() > 0.0
    faces = np.sort(np.concatenate([corners[:, face] for face in _FACES]), axis=1)
    unique, counts = np.unique(faces, axis=0, return_counts=True)
    assert counts.max() == 2
    surface = {tuple(face) for face in unique[counts == 1].tolist()}
    edges = [pair for a, b, c in surface for pair in ((a, b), (b, c), (a, c))]
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}
    dividing = [f[:, :3] for name, f in mesh.facet_sets.items() if name not in patches]
    named = np.sort(np.concatenate(dividing), axis=1)
    assert len(named) == len(surface)
    assert {tuple(face) for face in named.tolist()} == surface
    assert len(np.unique(mesh.elements)) == len(mesh.nodes)


def order_of(errors, ratio=2.0):
    """Measured order of convergence between successive refinements by ``ratio``."""
    errors = np.abs(errors)
    return np.log(errors[:-1] / errors[1:]) / np.log(ratio)
