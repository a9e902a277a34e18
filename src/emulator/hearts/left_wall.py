r"""The left ventricle's wall cut from a heart whose outer surface wraps both ventricles.

Its outside is the epicardium on the free wall and the right ventricle's endocardium on the septum;
where they meet, the wall goes on into the right one's. From a point x of the left endocardium with
normal n the outside is at

.. math:: x + s\,n, \qquad s = \min(h,\; c\, d),

with the distance d to the nearest point of the two surfaces and the way h to where the normal meets
one of them. The ball of radius d around x is tissue, and d changes by no more than x does, so the
cut at the junction is even; with :math:`c = 1.3` normals go their own way elsewhere.

At the valves the surfaces of a scanner meet, and the wall thins towards them. The base plane is
across the area vector of the endocardium's openings, as high as the wall has half of its thickness.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.core.errors import InputError
from emulator.hearts.surfaces import Surface, axis_to_rims, nearest, neighbour_means

_FARTHEST = 1.3  # times the nearest distance
_EVEN = 20  # passes that smooth normals and distances
_THIN = 0.5  # thickness over the median of what is left of the wall at its base
_FAR = 3.0  # median thickness over which the others are not around the endocardium, of its extent


class LeftWall(NamedTuple):
    """The left ventricle's part of a heart.

    outside : its outer surface, with a point for each of the endocardium.
    axis : the base plane's normal (3,), from apex to base.
    height : the height of the base plane along it, mm.
    """

    outside: Surface
    axis: np.ndarray
    height: float


def left_wall(endocardium: Surface, epicardium: Surface, right: Surface) -> LeftWall:
    """Return the outer surface of the left ventricle's wall, its axis and its base height.

    Parameters
    ----------
    endocardium : the left ventricle's, open at its valves. epicardium : that of both ventricles.
    right : the right ventricle's endocardium, the septum's right side included.

    :class:`InputError` for a closed endocardium, or surfaces that are not around it.
    """
    rims = endocardium.rims
    if not rims:
        raise InputError(
            "endocardium: it is closed; cut from a heart of two ventricles it is open at its valves"
        )
    edges = np.concatenate(rims)
    axis = axis_to_rims(endocardium)
    points, around = endocardium.points, (epicardium, right)
    heights, edges_of = points @ axis, endocardium.mesh.edges
    selves = np.repeat(np.arange(len(points))[:, None], 2, axis=1)
    mean = neighbour_means(np.vstack([edges_of, edges_of[:, ::-1], selves]), len(points))
    normals = endocardium.mesh.vertex_normals
    for _ in range(_EVEN):
        normals = mean @ normals
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    farthest = _FARTHEST * nearest(around, points)[1]
    if _FAR * (median := float(np.median(farthest)) / _FARTHEST) > endocardium.extent:
        raise InputError(
            f"the epicardium and the right ventricle are {median:.3g} mm away from the left "
            f"endocardium, of {endocardium.extent:.3g} mm: are they of one heart, in one unit?"
        )
    ways = np.full(len(points), np.inf)
    for other in around:
        places, row, _ = other.mesh.ray.intersects_location(points, normals)
        np.minimum.at(ways, row, np.linalg.norm(places - points[row], axis=1))
    ways = np.where(np.isfinite(ways), np.minimum(ways, farthest), farthest / _FARTHEST)
    for _ in range(_EVEN):
        ways = np.minimum(mean @ ways, farthest)
    outside = points + ways[:, None] * normals
    thin = (ways < _THIN * np.median(ways)) & (heights > heights.mean())
    low = min(heights[edges].min(), heights[thin].min(initial=np.inf))
    return LeftWall(Surface("epicardium", outside, endocardium.triangles), axis, float(low))
