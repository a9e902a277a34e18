r"""The 17 segments of the left ventricle (American Heart Association; Cerqueira et al. 2002).

The long axis is divided in three from the base plane to the tip of the cavity; what lies beyond the
tip is segment 17. Around the axis, angles :math:`\varphi` start in the middle of the anterior wall
and go anticlockwise as seen from the apex, as short-axis images are drawn:

=========  ===========  ===============================================================
third      segments     centred at
=========  ===========  ===============================================================
basal      1 to 6       0, 60, ..., 300 degrees: anterior, anteroseptal, inferoseptal,
                        inferior, inferolateral, anterolateral
mid        7 to 12      0, 60, ..., 300 degrees, named as the basal ones
apical     13 to 16     0, 90, 180, 270 degrees: anterior, septal, inferior, lateral
apex       17
=========  ===========  ===============================================================
"""

from __future__ import annotations

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.fibres import Axis
from emulator.geometry.mesh import Mesh

SEGMENTS = 17
# Decimals kept, so that a centroid on a border gets the same segment on every machine.
_DIGITS = 9


def aha_segments(
    mesh: Mesh,
    endocardium: str = "endocardium",
    axis: Axis = (0.0, 0.0, 1.0),
    through: Axis = (0.0, 0.0, 0.0),
    anterior: Axis = (0.0, 1.0, 0.0),
) -> np.ndarray:
    """Segment (m,), 1 to 17, that the centroid of each element lies in.

    Parameters
    ----------
    mesh : any left ventricle, linear or quadratic, without the right one's free wall.
    endocardium : facet set of its cavity; its lowest and highest node along the axis are the
        cavity's tip and the base.
    axis : from apex to base, any length.
    through : a point on the axis, mm.
    anterior : from the axis to the middle of the anterior wall, any length; its component along
        the axis is ignored. The default puts the septum towards positive x, as in
        :mod:`~emulator.geometry.generators.biventricle`.

    Raises
    ------
    InputError
        A zero direction, or a mesh so coarse that a segment has no element.
    """
    up = _unit(np.asarray(axis, dtype=float), "axis", axis)
    front = np.asarray(anterior, dtype=float)
    front = _unit(front - (front @ up) * up, "direction across the axis, anterior", anterior)
    centroids = mesh.nodes[mesh.elements[:, :4]].mean(axis=1) - np.asarray(through, dtype=float)
    cavity = mesh.nodes[np.unique(mesh.facet_set(endocardium))] @ up - np.dot(through, up)
    # From 0 at the cavity's tip to 1 at the base.
    height = np.round((centroids @ up - cavity.min()) / np.ptp(cavity), _DIGITS)
    turn = np.arctan2(centroids @ np.cross(front, up), centroids @ front) / (2.0 * np.pi)
    labels = np.select(
        [height >= 2.0 / 3.0, height >= 1.0 / 3.0, height >= 0.0],
        [1 + _sector(turn, 6), 7 + _sector(turn, 6), 13 + _sector(turn, 4)],
        SEGMENTS,
    )
    empty = np.setdiff1d(np.arange(1, SEGMENTS + 1), labels)
    if empty.size:
        raise InputError(
            f"segments: none of the {len(labels)} elements is in segment "
            f"{', '.join(map(str, empty))}; refine the mesh, or check the axis"
        )
    return labels


def _sector(turn: np.ndarray, count: int) -> np.ndarray:
    """Sector 0 to ``count - 1`` of each ``turn`` (m,), a full turn being 1; 0 is centred at 0."""
    return np.floor(np.round(turn * count + 0.5, _DIGITS)).astype(int) % count


def _unit(vector: np.ndarray, name: str, given: Axis) -> np.ndarray:
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not np.isfinite(length) or not length > 1e-12:
        raise InputError(f"segments: no {name}: {given}; expected three numbers, not all zero")
    return vector / length
