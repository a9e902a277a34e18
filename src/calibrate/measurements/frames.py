r"""Surfaces of image frames as data: their distances from the body at rest along its normals.

At points X of a facet set with normal n, the surface of a frame is met by the line along the
normal at

.. math:: s = \min |s| \quad\text{with}\quad X + s\, n \in \text{surface} ,

on a triangle that faces as the facet does. That is an observation ``surface``
(:mod:`calibrate.measurements.surface`): what slides along the surface is not seen. Points are
spread evenly, away from rims, which a surface of another frame need not reach. The cavity within a
frame's surface, with flat lids on its openings, is an observation ``volume``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial import cKDTree

from calibrate.measurements.collection import Observations, observations
from calibrate.measurements.full_field import spread_points
from calibrate.measurements.location import facet_shapes
from calibrate.measurements.observation import Observation
from calibrate.measurements.surface import SurfacePoints
from calibrate.measurements.volume import CavityVolume
from calibrate.state_names import in_state, split
from emulator.core.errors import InputError
from emulator.core.units import IN_ML
from emulator.geometry.facets import enclosed_volume, encloses, openings, rim
from emulator.geometry.mesh import Mesh
from emulator.hearts.surfaces import Surface
from emulator.scenes.scene import Scene, cavity_sets

POINTS = 60
"""Default number of points of a surface."""
_MARGIN = 0.05  # of the body's size, from rims to the nearest point
_REACH = 0.2  # of the body's size, the farthest that a surface may be away
_STEEP = 0.3  # cosine between normal and triangle below which the line grazes it


def frame_data(
    scene: Scene, surfaces: Mapping[str, Surface], points: int = POINTS
) -> tuple[Observations, dict[str, np.ndarray]]:
    """Return the observations that surfaces of frames make, and their data.

    Parameters
    ----------
    scene : the scene, whose mesh is the body at rest, or the loaded body of an image.
    surfaces : the surface of a frame by facet set and load state, ``lv_endocardium@systole``.
    points : the number of points of each facet set.

    Raises
    ------
    InputError
        An unknown facet set, fewer than 1 point, or a surface that is nowhere near its facet set.
    """
    if points < 1:
        raise InputError(f"{points} points; give 1 or more")
    observe, data = dict[str, Observation](), dict[str, np.ndarray]()
    places, sides = dict[str, SurfacePoints](), dict[str, float]()
    for name, surface in surfaces.items():
        facet_set, state = split(name)
        at = in_state("", state)
        if facet_set not in places:
            even = spread_evenly(scene.mesh, facet_set, points)
            places[facet_set] = SurfacePoints.of(scene, facet_set, even)
            sides[facet_set] = _outward(scene.mesh, facet_set)
        part = places[facet_set]
        reach = _REACH * scene.mesh.size
        ways = along_normals(part.points, part.normals, surface, reach, sides[facet_set])
        if np.isnan(ways).mean() > 0.5:
            raise InputError(
                f"'{name}': only {int(np.isfinite(ways).sum())} of {len(ways)} lines along the "
                f"normals of '{facet_set}' meet the surface within "
                f"{reach:.3g} mm; is it of this wall, in the mesh's place and unit?"
            )
        observe[f"surface:{facet_set}{at}"], data[f"surface:{facet_set}{at}"] = part, ways
        rims = len(openings(scene.mesh.facet_set(facet_set)))
        if facet_set in cavity_sets(scene) and len(surface.rims) == rims:
            volume = f"volume:{facet_set}{at}"
            observe[volume] = CavityVolume(scene, facet_set)
            data[volume] = np.array(surface.volume * IN_ML["mm3"])
    return observations(observe), data


def spread_evenly(mesh: Mesh, facet_set: str, count: int) -> np.ndarray:
    """Return middles (count, 3) mm of facets of a set, each the farthest from those before it.

    :class:`InputError` where the set has fewer facets away from its rims.
    """
    facets = mesh.facet_set(facet_set)
    values, _ = facet_shapes(np.full((1, 3), 1.0 / 3.0), facets.shape[1])
    places = np.einsum("a,kai->ki", values[0], mesh.nodes[facets])
    edges = mesh.nodes[np.unique(rim(facets))]
    if len(edges):
        far = cKDTree(edges, balanced_tree=False).query(places)[0] > _MARGIN * mesh.size
        places = places[far]
    if len(places) < count:
        raise InputError(
            f"facet set '{facet_set}' has {len(places)} facets away from its rims; "
            + (f"ask for fewer points than {count}" if len(places) else "observe another")
        )
    return places[spread_points(places, count)]


def _outward(mesh: Mesh, facet_set: str) -> float:
    """Return 1 where the facets' normals point out of what they enclose, -1 into it, 0 of none."""
    if not encloses(mesh, facet_set):
        return 0.0
    volume: Callable[[np.ndarray], np.ndarray] = enclosed_volume(mesh.facet_set(facet_set))
    return float(np.sign(volume(mesh.nodes - mesh.nodes.mean(axis=0))))


def along_normals(
    points: np.ndarray, normals: np.ndarray, surface: Surface, reach: float, outward: float = 0.0
) -> np.ndarray:
    """Return signed distances (d,) in mm from ``points`` to a surface, along ``normals`` (d, 3).

    NaN where the line does not meet it within ``reach`` mm to either side.

    outward : 1 where the normals point out of what the surface encloses, as its triangles do, -1
        where they point into it: walls on the other side of a cavity do not count. 0 for what most
        of the nearest triangles say.
    """
    count = len(points)
    places, row, triangle = surface.mesh.ray.intersects_location(
        np.tile(points, (2, 1)), np.vstack([normals, -normals])
    )
    places, row = places.reshape(-1, 3), row % count
    ways = np.einsum("ki,ki->k", places - points[row], normals[row])
    cosines = np.einsum("ki,ki->k", surface.mesh.face_normals[triangle], normals[row])
    meets = (np.abs(ways) <= reach) & (np.abs(cosines) > _STEEP)
    order = np.argsort(-np.abs(ways))  # the nearest comes last, and stays

    def nearest(values: np.ndarray, of: np.ndarray) -> np.ndarray:
        result, last = np.full(count, np.nan), order[of[order]]
        result[row[last]] = values[last]
        return result

    side = outward or np.sign(np.nansum(np.sign(nearest(cosines, meets))))
    return nearest(ways, meets & (side * cosines > 0.0))
