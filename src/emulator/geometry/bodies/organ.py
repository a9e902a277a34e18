r"""An organ-like body: a ball mapped smoothly to a lobed, bent, asymmetric shape.

.. math:: X = a\,x, \qquad Y = b\,(1 - \tau x)\,y + \beta b\,x^2, \qquad
          Z = c\,(1 - \sigma x)\,z - \beta c\,x^2

for :math:`|(x, y, z)| \le 1`. The map is triangular, so its determinant
:math:`abc\,(1 - \tau x)(1 - \sigma x)` is positive, and the volume is
:math:`\tfrac{4}{3}\pi abc\,(1 + \tau\sigma/5)`.
"""

from __future__ import annotations

import numpy as np

from emulator.errors import InputError
from emulator.geometry.bodies.ball import ball, ball_midpoints
from emulator.geometry.bodies.body import body
from emulator.geometry.mesh import Mesh

# One lobe is thick and high, the other tapers; the underside is hollow.
_TAPER_Y, _TAPER_Z, _BEND = 0.35, 0.5, 0.3
# The ligament holds the top, to the side of the thick lobe.
_LIGAMENT_DIRECTION = np.array([-0.4, -0.3, np.sqrt(0.75)])
_LIGAMENT_HALF_ANGLE = np.radians(32.0)


def organ(
    half_axes: tuple[float, float, float] = (75.0, 45.0, 38.0), shells: int = 6, order: int = 1
) -> Mesh:
    """A liver-like body; its dimensions are our choice.

    Parameters
    ----------
    half_axes : a, b, c in mm.
    shells : of the ball that is mapped; 6 give 923 nodes.
    order : 1, or 2 for quadratic elements with their mid-edge nodes on the true surface.

    Returns
    -------
    Mesh with node set ligament, a patch of the surface to hold, and facet set surface.
    """
    if not 0.0 < min(half_axes) <= max(half_axes) < np.inf:
        raise InputError(f"organ: half axes {half_axes} mm must be positive and finite")
    if shells < 2:
        raise InputError(f"organ: {shells} shells; expected at least 2")
    nodes, elements = ball(shells)
    surface = np.flatnonzero(np.linalg.norm(nodes, axis=1) > 1.0 - 0.5 / shells)
    held = nodes[surface] @ _LIGAMENT_DIRECTION > np.cos(_LIGAMENT_HALF_ANGLE)
    middle = ball_midpoints(nodes)
    return body(
        _shape(nodes, half_axes),
        elements,
        {"surface": surface},
        {"ligament": surface[held]},
        lambda edges: _shape(middle(edges), half_axes),
        order,
    )


def volume(half_axes: tuple[float, float, float]) -> float:
    """Volume of the true body in mm3."""
    a, b, c = half_axes
    return 4.0 / 3.0 * np.pi * a * b * c * (1.0 + _TAPER_Y * _TAPER_Z / 5.0)


def _shape(points: np.ndarray, half_axes: tuple[float, float, float]) -> np.ndarray:
    """The map of this module, (k, 3) of the unit ball to (k, 3) in mm."""
    x, y, z = points.T
    a, b, c = half_axes
    return np.column_stack(
        [
            a * x,
            b * ((1.0 - _TAPER_Y * x) * y + _BEND * x**2),
            c * ((1.0 - _TAPER_Z * x) * z - _BEND * x**2),
        ]
    )
