r"""The element a material point lies in, and the shape functions there.

scikit-fem finds the element of a point inside the body. A point outside, or inside a curved element
but not inside its straight-edged one, is moved onto the nearest element, by inverting the element's
map :math:`x(\xi) = \sum_a N_a(\xi)\, X_a` with Newton's method.
"""

from __future__ import annotations

import numpy as np
from skfem import MeshTet

from emulator.core.errors import InputError
from emulator.geometry.discretisation import shapes_at
from emulator.geometry.mesh import Mesh

# How far outside the body a point may lie, as a fraction of the body's size. Measured surface
# points rarely lie on the mesh to the last digit.
_SLACK = 1e-3
_SEVERAL, _LEAST, _MOST = 3, 0.003, 5.0  # points; their span as a share of the body's
_UNITS = {"m": 1e3, "cm": 10.0, "µm": 1e-3}
_ON_THE_FACE = 1e-9  # round-off of a barycentric coordinate
_CANDIDATES = 32  # nearest elements, by their straight-edged shape, in which a point is sought
_NEWTON_STEPS = 12  # at most; an element with straight edges takes one


def locate(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Element (d,) of each point (d, 3), and the element's shape functions there (d, 4 or 10).

    Raises
    ------
    InputError
        A point further outside than a thousandth of the body's size.
    """
    elements, inside = _find(mesh, points)
    return elements, shapes_at(mesh.order, inside)[0]


def locate_gradients(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Element (d,) of each point (d, 3), its barycentric coordinates (d, 4), and gradients.

    These are the shape functions' in the reference body, (d, 4 or 10, 3) in 1/mm.
    """
    elements, inside = _find(mesh, points)
    _, slopes = shapes_at(mesh.order, inside)
    jacobian = np.einsum("dai,daj->dij", mesh.nodes[mesh.elements[elements]], slopes)
    # NumPy, no batched LAPACK of JAX's.
    return elements, inside, np.einsum("daj,dji->dai", slopes, np.linalg.inv(jacobian))


def _find(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Element (d,) of each point and its barycentric coordinates there, (d, 4)."""
    _check_extent(mesh, points)
    straight = MeshTet(mesh.nodes.T.copy(), mesh.corners.T.copy(), sort_t=False, validate=False)
    finder, nodes = straight.element_finder(), mesh.nodes[mesh.elements]
    elements, coordinates = [], []
    for k, point in enumerate(points):
        try:
            found = finder(*point[:, None])
        except ValueError:  # outside every straight-edged element
            found = None
        inside = None if found is None else _invert(nodes[found], point)[0]
        if found is None or inside is None or not inside.min() >= -_ON_THE_FACE:
            found, inside = _nearest(mesh, k, point)
        elements.append(int(found[0]))
        coordinates.append(inside[0])
    return np.array(elements), np.array(coordinates)


def _check_extent(mesh: Mesh, points: np.ndarray) -> None:
    """Refuse several points that are together next to nothing of the body, or far more than it."""
    if len(points) < _SEVERAL:
        return
    span, body = (float(np.ptp(x, axis=0).max()) for x in (points, mesh.nodes))
    if span == 0.0 or _LEAST * body <= span <= _MOST * body:
        return
    # The unit whose points would span nearest to the body's size.
    unit, factor = min(_UNITS.items(), key=lambda item: abs(np.log(item[1] * span / body)))
    raise InputError(
        f"{len(points)} points span {span:.3g} mm, the body {body:.3g} mm: {unit} instead of mm? "
        f"multiply their coordinates by {factor:g}"
    )


def _invert(X: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates (c, 4) of ``point`` in elements with nodes ``X`` (c, a, 3).

    They are not clipped: one below 0 says that the point lies beyond a face. Also their gradients
    (c, 4, 3) in space, 1/mm.
    """
    order = 1 if X.shape[1] == 4 else 2
    xi = np.full((len(X), 3), 0.25)
    for _ in range(1 if order == 1 else _NEWTON_STEPS):
        values, slopes = shapes_at(order, _barycentric(xi))
        # d xi / d x, the inverse of the element map's Jacobian; NumPy, no batched LAPACK of JAX's.
        inverse = np.linalg.inv(np.einsum("cai,caj->cij", X, slopes))
        step = np.einsum("cji,ci->cj", inverse, point - np.einsum("ca,cai->ci", values, X))
        # The map of a curved element folds far outside it; Newton is kept from going there.
        xi = xi + step if order == 1 else np.clip(xi + step, -0.5, 1.5)
        if np.abs(step).max() < 1e-13:
            break
    return _barycentric(xi), np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)


def _barycentric(xi: np.ndarray) -> np.ndarray:
    return np.concatenate([1.0 - xi.sum(axis=1, keepdims=True), xi], axis=1)


def _nearest(mesh: Mesh, k: int, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The element nearest to ``point``, and barycentric coordinates (1, 4) of the point on it."""
    every = mesh.nodes[mesh.elements]
    distances, _ = _onto(every[:, :4], point)
    near = np.argsort(distances, kind="stable")[:_CANDIDATES]
    distances, inside = _onto(every[near], point)
    best = int(np.argmin(distances))
    if not distances[best] <= _SLACK * mesh.size:
        raise InputError(
            f"landmark {k} at {point.tolist()} mm lies outside the body, "
            f"about {distances[best]:.2g} mm away"
        )
    return near[[best]], inside[[best]]


def _onto(X: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (c,) of ``point`` to elements with nodes ``X`` (c, a, 3), and where it meets them.

    Beyond a face, the point goes back onto it along the face's normal; coordinates that are still
    below 0 are clipped.
    """
    coordinates, gradients = _invert(X, point)
    rows = np.arange(len(X))
    lowest = np.argmin(coordinates, axis=1)
    normal = gradients[rows, lowest]
    beyond = np.minimum(coordinates[rows, lowest], 0.0) / np.sum(normal**2, axis=1)
    inside = coordinates - beyond[:, None] * np.einsum("cai,ci->ca", gradients, normal)
    inside = np.maximum(inside, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    shapes, _ = shapes_at(1 if X.shape[1] == 4 else 2, inside)
    reached = np.einsum("ca,cai->ci", shapes, X)
    return np.linalg.norm(reached - point, axis=1), inside
