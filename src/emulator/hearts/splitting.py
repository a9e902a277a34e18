r"""One closed surface of the muscle, both walls and the ring at the base, split at the base.

A cup's convex hull covers its mouth: the hull's triangles that lie away from the surface are the
mouth, and their mean normal is the long axis. Planes across it are lowered from the mouth until
nothing of the ring, which faces the base, is left below, and the surface falls apart: into the
epicardium, which has most within it, and one or two endocardia.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.mesh import parts
from emulator.hearts.checks import roundness
from emulator.hearts.surfaces import Surface, clipped, distances, surface

_MOUTH = 0.2  # of the largest distance from the hull to the surface, above which it is the mouth
_ALIKE = 0.9  # cosine between normals of one mouth
_UP, _NEAR = 0.7, 0.03  # cosine to the axis, and share of the height below a plane, of the ring
_LEFT = 0.01  # of the area near a plane, that may still be of the ring
_FARTHEST_DOWN, _STEPS = 0.25, 100  # of the height, to where planes are lowered, and in how many
_SNAP = 1e-4  # of the extent: points this near a plane lie in it
_LEAST = 0.02  # of what the largest piece encloses; smaller ones are no ventricle


def split_muscle(
    muscle: Surface,
    axis: Sequence[float] | None = None,
    height: float | None = None,
    point: Sequence[float] | None = None,
) -> tuple[list[Surface], np.ndarray]:
    """Return the endocardia of a closed surface, left first and epicardium last, and the axis.

    Parameters
    ----------
    muscle : the closed surface.
    axis : from apex to base, of any length; found from the mouth by default.
    height, point : the base plane; by default as high as the surface falls apart.

    :class:`InputError` where no plane near the mouth leaves two walls, or three.
    """
    normal = _mouth(muscle) if axis is None else np.asarray(axis, dtype=float)
    normal = normal / np.linalg.norm(normal)
    along = muscle.points @ normal
    lowest = along.max() - _FARTHEST_DOWN * np.ptp(along)
    levels = np.linspace(along.max(), lowest, _STEPS + 1)
    if height is not None or point is not None:
        levels = np.array([height if point is None else np.asarray(point, float) @ normal])
    for level in levels:
        above = along - level
        above[np.abs(above) < _SNAP * muscle.extent] = 0.0
        if not above.min() < 0.0:
            continue
        below = clipped(muscle, above)
        near = below.mesh.triangles_center @ normal > level - _NEAR * np.ptp(along)
        of_ring = near & (below.mesh.face_normals @ normal > _UP)
        is_clean = below.mesh.area_faces[of_ring].sum() <= _LEFT * below.mesh.area_faces[near].sum()
        pieces = _pieces(below) if is_clean or len(levels) == 1 else []
        if len(pieces) in (2, 3) and all(len(piece.rims) == 1 for piece in pieces):
            *inner, outer = pieces
            return [*sorted(inner, key=roundness, reverse=True), outer], normal
    raise InputError(
        f"{muscle.name}: it is closed, and no plane across {np.round(normal, 3).tolist()} in its "
        "upper quarter leaves two walls: if it is the whole muscle, both walls in one surface, "
        "give --axis from apex to base, and --base-height below the ring; or cut it into two files"
    )


def _mouth(muscle: Surface) -> np.ndarray:
    """Return the mean normal (3,) of the hull over the mouth, or over several beside each other."""
    hull = muscle.mesh.convex_hull
    away, areas = distances(hull.triangles_center, [muscle]), hull.area_faces[:, None]
    deepest = hull.face_normals[np.argmax(away)]
    over = (away > _MOUTH * away.max()) & (hull.face_normals @ deepest > _ALIKE)
    return (hull.face_normals * areas)[over].sum(axis=0)


def _pieces(whole: Surface) -> list[Surface]:
    """Return the parts of an open surface by what they enclose, the largest last."""
    label = parts(whole.triangles, len(whole.points))[whole.triangles[:, 0]]
    rows = (whole.triangles[label == k] for k in np.unique(label))
    pieces = [surface(whole.name, whole.points, of) for of in rows if len(of) > 3]
    pieces.sort(key=lambda piece: piece.volume)
    return [piece for piece in pieces if piece.volume > _LEAST * pieces[-1].volume]
