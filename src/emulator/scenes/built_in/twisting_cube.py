"""A cube twisted at one face (Dalton et al. 2023, Section 3.2)."""

from __future__ import annotations

import numpy as np

from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes.built_in.resolution import resolved
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

_SIZES = {1: {"cells": 6}, 2: {"cells": 4}}  # cells along each edge by default


def twisting_cube(
    cells: int | None = None, edge: float = 10.0, degrees: float = 60.0, order: int = 2
) -> Scene:
    """A cube clamped at its left face, its right face twisted about the x axis.

    Each point of the right face moves halfway along the chord of a rigid rotation by ``degrees``,
    as published. theta = (E, nu), 1 to 25 kPa, 0.1 to 0.4.

    Parameters
    ----------
    cells : the number of cells along each edge; the default depends on the order.
    edge : the length of an edge, mm.
    degrees : the angle of the rotation whose half chord is prescribed.
    order : the order of the elements; 1 as published.
    """
    count = resolved(_SIZES, order, cells=cells)["cells"]
    mesh = box((edge,) * 3, (count,) * 3, order)
    right = mesh.nodes[mesh.node_set("right")]
    displacement = 0.5 * twist(right, np.full(3, edge / 2.0), degrees)
    return Scene(
        name="twisting_cube",
        mesh=mesh,
        law=find_law("neo_hookean_E_nu"),
        parameters=(
            Parameter("E", "kPa", 1.0, 25.0, "log"),
            Parameter("nu", "", 0.1, 0.4, "log"),
        ),
        supports=(Support("left"), Support("right", displacement)),
        origin={
            "scene": "twisting_cube",
            "cells": count,
            "edge": edge,
            "degrees": degrees,
            "order": order,
        },
    )


def twist(points: np.ndarray, centre: np.ndarray, degrees: float) -> np.ndarray:
    """Return the displacement (k, 3) of a rigid rotation of ``points`` (k, 3).

    Parameters
    ----------
    points : the coordinates (k, 3) in mm.
    centre : a point (3,) on the axis of rotation, which is parallel to x.
    degrees : the angle of rotation.
    """
    angle = np.deg2rad(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    displacement = np.zeros_like(points)
    arm = points[:, 1:] - centre[1:]
    displacement[:, 1:] = arm @ rotation.T - arm
    return displacement
