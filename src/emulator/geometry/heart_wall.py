r"""Coordinates of a ventricle's wall that move with the body, and its 17 segments.

**Coordinates.** The long axis :math:`k` is the mean normal of the base, the facets that are fixed
on all corners, and points out of the tissue; the origin is the mean of the cavity's rim. Lengths
are relative to :math:`L = (V_\text{cavity} + V_\text{wall})^{1/3}`. With the transmural direction
:math:`n` of :mod:`emulator.geometry.fibres` and :math:`c = k \times n`, which vanishes smoothly
where the wall turns round the apex, a node has the vectors :math:`n, c, k`, its offset
:math:`x_\perp` from the axis and :math:`k \times x_\perp`. A body that is thicker on one side also
has the direction :math:`g` of its tissue's centroid from the axis. These vectors turn with the
body; all products of two of them do not.

**Segments** of the left ventricle (American Heart Association; Cerqueira et al. 2002). The long
axis is divided in three from the base plane to the tip of the cavity; what lies beyond the tip is
segment 17. Around the axis, angles :math:`\varphi` start in the middle of the anterior wall and go
anticlockwise as seen from the apex, as short-axis images are drawn:

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

from dataclasses import dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.core.units import MM3_PER_ML
from emulator.geometry.facets import Cavity, mean_normal
from emulator.geometry.fibres import Axis, nodal_depth
from emulator.geometry.mesh import Mesh, find_rows, signed_volumes

_SMALL = 0.02  # offset of a centroid, relative to L, that makes a direction of its own


@dataclass(frozen=True, eq=False)
class Ventricle:
    """The wall of one ventricle; ``n`` nodes, of which all are corners.

    size : L in mm. axis : (3,) k. cavity, wall : volumes over L^3, which sum to one.
    offset : (n, 3) from the origin, over L. depth : (n,) 0 on the endocardium, 1 outside.
    normal : (n, 3). inner, held : whether nodes are on the endocardium or fixed, (n,) bool.
    lean : (3,) g, shorter than one; zero in a body of revolution.
    """

    size: float
    axis: np.ndarray
    cavity: float
    wall: float
    offset: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    inner: np.ndarray
    held: np.ndarray
    lean: np.ndarray

    @property
    def height(self) -> np.ndarray:
        """Along the axis from the origin, over L; below zero towards the apex, (n,)."""
        return self.offset @ self.axis

    @property
    def across(self) -> np.ndarray:
        """Offset from the axis, over L, (n, 3)."""
        return self.offset - self.height[:, None] * self.axis

    @property
    def circumference(self) -> np.ndarray:
        """The axis times the normals, (n, 3); as long as the sine of the angle between."""
        return np.cross(self.axis, self.normal)

    def vectors(self) -> np.ndarray:
        """The vectors (n, 7, 3) that turn with the body: n, c, k, x, k x x, g, k x g."""
        k, count = np.broadcast_to(self.axis, self.normal.shape), len(self.normal)
        lean = np.broadcast_to(self.lean, (count, 3))
        around = np.cross(self.axis, self.across)
        rows = (self.normal, self.circumference, k, self.across, around, lean, np.cross(k, lean))
        return np.stack(rows, axis=1)


def ventricle(mesh: Mesh, endocardium: str, fixed: np.ndarray) -> Ventricle:
    """Return the wall around the cavity ``endocardium``, whose nodes ``fixed`` (n,) are fixed.

    :class:`InputError` for quadratic elements, no base, or a rim of the cavity that is not in it.
    """
    if mesh.order != 1:
        raise InputError("its elements are quadratic; expected linear tetrahedra")
    surface = mesh.surface
    base = fixed[surface].all(axis=1)
    endocardial_facets = mesh.facet_set(endocardium)
    nodes = np.arange(len(mesh.nodes))
    inner = np.isin(nodes, endocardial_facets)
    rim = inner & fixed
    if not base.any() or not rim.any():
        raise InputError("it has no base: no facets held on all corners that meet the cavity")
    outside = surface[~base & (find_rows(surface, endocardial_facets) < 0)]
    outer = np.isin(nodes, outside) & ~inner
    if not outer.any():
        raise InputError("its surface is all cavity and base; expected an outside")
    axis = mean_normal(mesh.nodes[surface[base]])
    volumes = signed_volumes(mesh.nodes, mesh.elements)
    nodal = np.zeros(len(mesh.nodes))
    np.add.at(nodal, mesh.elements, volumes[:, None] / 4.0)
    cavity, wall = Cavity(mesh, endocardium).rest * MM3_PER_ML, float(volumes.sum())
    size = (cavity + wall) ** (1.0 / 3.0)
    offset = (mesh.nodes - mesh.nodes[rim].mean(axis=0)) / size
    depth = nodal_depth(mesh, np.flatnonzero(inner), np.flatnonzero(outer))
    centroid = nodal @ offset / wall
    centroid -= (centroid @ axis) * axis
    return Ventricle(
        size=size,
        axis=axis,
        cavity=cavity / size**3,
        wall=wall / size**3,
        offset=offset,
        depth=depth.value,
        normal=depth.normal,
        inner=inner,
        held=fixed,
        lean=centroid / np.hypot(np.linalg.norm(centroid), _SMALL),
    )


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
    """Return the segment (m,), 1 to 17, that the centroid of each element lies in.

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
    # The sector from 0 to 5, or from 0 to 3; 0 is centred at 0.
    six, four = (np.floor(np.round(turn * n + 0.5, _DIGITS)).astype(int) % n for n in (6, 4))
    thirds = [height >= 2.0 / 3.0, height >= 1.0 / 3.0, height >= 0.0]
    labels = np.select(thirds, [1 + six, 7 + six, 13 + four], SEGMENTS)
    empty = np.setdiff1d(np.arange(1, SEGMENTS + 1), labels)
    if empty.size:
        raise InputError(
            f"segments: none of the {len(labels)} elements is in segment "
            f"{', '.join(map(str, empty))}; refine the mesh, or check the axis"
        )
    return labels


def _unit(vector: np.ndarray, name: str, original: Axis) -> np.ndarray:
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not np.isfinite(length) or not length > 1e-12:
        raise InputError(f"segments: no {name}: {original}; expected three numbers, not all zero")
    return vector / length
