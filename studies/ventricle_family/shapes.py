"""Ventricles of many shapes and meshes, for one network to learn from.

The shapes fill a box of dimensions in a low-discrepancy sequence. Its ranges are our choice, about
twice as wide as the spread of healthy adult hearts, and take in the built-in ``left_ventricle``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from emulator.scenes.built_in.ventricles import left_ventricle
from emulator.scenes.scene import Scene

SHAPES = {
    "radius": (18.0, 28.0),
    "length": (45.0, 72.0),
    "thickness": (7.0, 14.0),
    "apex": (0.55, 0.95),
    "truncation": (0.15, 0.5),
    "endocardium": (45.0, 80.0),
    "epicardium": (-75.0, -40.0),
    "thicker": (0.0, 0.25),
    "towards": (0.0, 360.0),
    "rings": (11, 16),
    "around": (22, 32),
    "layers": (2, 3),
}
"""Ranges of the family.

radius, length : semi-axes of the endocardium, mm. thickness : of the wall at the equator, mm.
apex : its thickness there over that at the equator. truncation : height of the base plane over the
ellipsoids' centre, over ``length``. endocardium, epicardium : helix angles in degrees. thicker,
towards : how much thicker the wall is at the base on one side, and the side in degrees. rings,
around, layers : of the mesh.
"""


def ventricles(count: int, seed: int) -> list[dict[str, Any]]:
    """Return the arguments of :func:`~emulator.scenes.left_ventricle` for ``count`` ventricles."""
    from scipy.stats import qmc  # half a second, which other scenes need not wait for

    points = qmc.Sobol(len(SHAPES), rng=seed).random_base2(max(count - 1, 1).bit_length())[:count]
    return [_arguments(point) for point in points]


def family(count: int, seed: int) -> list[Scene]:
    """``count`` ventricles of the family."""
    return [left_ventricle(**arguments) for arguments in ventricles(count, seed)]


def _arguments(point: np.ndarray) -> dict[str, Any]:
    """The ventricle at ``point`` of the unit box."""
    at: dict[str, Any] = {}
    for (name, (low, high)), x in zip(SHAPES.items(), point, strict=True):
        whole = isinstance(low, int)
        at[name] = int(low + x * (high - low + 1)) if whole else float(low + x * (high - low))
    radius, length, thickness = at["radius"], at["length"], at["thickness"]
    outside = (radius + thickness, length + at["apex"] * thickness)
    return {
        "rings": at["rings"],
        "around": at["around"],
        "layers": at["layers"],
        "order": 1,
        "angles": (at["endocardium"], at["epicardium"]),
        "wall": (radius, length, *outside, at["truncation"] * length),
        "thicker": (at["thicker"], at["towards"]),
    }
