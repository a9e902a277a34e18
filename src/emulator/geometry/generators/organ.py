r"""An organ-like body: a ball mapped smoothly to a lobed, bent, asymmetric shape.

.. math:: X = a\,x, \qquad Y = b\,(1 - \tau x)\,y + \beta b\,x^2, \qquad
          Z = c\,(1 - \sigma x)\,z - \beta c\,x^2

for :math:`|(x, y, z)| \le 1`. The map is triangular, so its determinant
:math:`abc\,(1 - \tau x)(1 - \sigma x)` is positive, and the volume is
:math:`\tfrac{4}{3}\pi abc\,(1 + \tau\sigma/5)`.
"""

from __future__ import annotations

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.generators.body import body
from emulator.geometry.generators.sphere import ball, ball_midpoints
from emulator.geometry.mesh import Mesh, boundary_facets, orient

# One lobe is thick and high, the other tapers; the underside is hollow.
_TAPER_Y, _TAPER_Z, _BEND = 0.35, 0.5, 0.3
# The ligament holds the top, to the side of the thick lobe.
_LIGAMENT_DIRECTION = np.array([-0.4, -0.3, np.sqrt(0.75)])
_LIGAMENT_HALF_ANGLE = np.radians(32.0)


def organ(
    half_axes: tuple[float, float, float] = (75.0, 45.0, 38.0),
    shells: int = 6,
    order: int = 1,
    clustering: float = 0.0,
    ligament_shells: int = 6,
) -> Mesh:
    """Return a liver-like body; its dimensions are our choice.

    Parameters
    ----------
    half_axes : a, b, c in mm.
    shells : the number of shells of the ball that is mapped; 6 give 923 nodes.
    order : 1, or 2 for quadratic elements with their mid-edge nodes on the true surface.
    clustering : above 0, below 1: elements at the ligament are smaller, by (1 - c) / (1 + c), and
        larger on the other side, none distorted: the ball is moved by a Moebius map.
    ligament_shells : the ligament is made of facets of the mesh of this many shells, whatever
        ``shells`` is. Meshes of a multiple cover it exactly; solutions of others do not converge to
        the same limit.

    Returns
    -------
    Mesh with node set and facet set ligament, a patch of the surface to hold, and facet set
    surface.
    """
    if not 0.0 < min(half_axes) <= max(half_axes) < np.inf:
        raise InputError(f"organ: half axes {half_axes} mm must be positive and finite")
    if shells < 2:
        raise InputError(f"organ: {shells} shells; expected at least 2")
    nodes, elements = ball(shells)
    surface = np.flatnonzero(np.linalg.norm(nodes, axis=1) > 1.0 - 0.5 / shells)
    if not 0.0 <= clustering < 1.0:
        raise InputError(f"organ: clustering {clustering}; expected from 0 to below 1")
    in_ligament = _in_ligament(nodes[surface], ligament_shells, clustering)
    middle = ball_midpoints(nodes)

    def mapped(points: np.ndarray) -> np.ndarray:
        return _shape(_moebius(points, clustering), half_axes)

    return body(
        mapped(nodes),
        elements,
        {"surface": surface, "ligament": surface[in_ligament]},
        {"ligament": surface[in_ligament]},
        lambda edges: mapped(middle(edges)),
        order,
    )


def _in_ligament(directions: np.ndarray, shells: int, clustering: float) -> np.ndarray:
    """Return whether each unit vector (k, 3) meets the ligament before the map, (k,) bool."""
    nodes, elements = ball(shells)
    triangles = boundary_facets(orient(nodes, elements))
    inside = _moebius(nodes, clustering) @ _LIGAMENT_DIRECTION > np.cos(_LIGAMENT_HALF_ANGLE)
    corners = nodes[triangles[inside[triangles].all(axis=1)]]  # (t, 3, 3)
    # A vector meets a triangle where it is a sum of its corners with no negative weight.
    weights = np.einsum("ki,tij->tkj", directions, np.linalg.inv(corners))
    return (weights > -1e-9).all(axis=2).any(axis=0)


def _moebius(points: np.ndarray, clustering: float) -> np.ndarray:
    r"""Return the Moebius map of the unit ball that takes its centre to :math:`a = c\, d`, (k, 3).

    .. math:: T(x) = \frac{(1 + 2 a \cdot x + |x|^2)\, a + (1 - |a|^2)\, x}
                          {1 + 2 a \cdot x + |a|^2 |x|^2}

    with the ligament's direction :math:`d`. It keeps all angles (Ratcliffe 2019, Section 4.5).
    """
    a = clustering * _LIGAMENT_DIRECTION
    along, square = 2.0 * (points @ a)[:, None], np.sum(points**2, axis=1)[:, None]
    numerator = (1.0 + along + square) * a + (1.0 - clustering**2) * points
    return numerator / (1.0 + along + clustering**2 * square)


def _shape(points: np.ndarray, half_axes: tuple[float, float, float]) -> np.ndarray:
    """Return the map of this module, (k, 3) of the unit ball to (k, 3) in mm."""
    x, y, z = points.T
    a, b, c = half_axes
    return np.column_stack(
        [
            a * x,
            b * ((1.0 - _TAPER_Y * x) * y + _BEND * x**2),
            c * ((1.0 - _TAPER_Z * x) * z - _BEND * x**2),
        ]
    )
