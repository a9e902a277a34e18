r"""A ventricle seen from itself: where each node lies in the wall, free of position and size.

The long axis :math:`k` is the mean normal of the base, the facets held on all corners, pointing out
of the tissue; the origin is the mean of the cavity's rim. Lengths are taken relative to
:math:`L = (V_\text{cavity} + V_\text{wall})^{1/3}`. With the transmural direction :math:`n` of
:mod:`emulator.geometry.fibres` and :math:`c = k \times n`, which vanishes smoothly where the wall
turns round the apex, a node has the vectors :math:`n, c, k`, its offset :math:`x_\perp` from the
axis and :math:`k \times x_\perp`; a body that is thicker on one side has the direction :math:`g` of
its tissue's centroid from the axis. Vectors turn with the body, and all products of two do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.cavity import MM3_PER_ML, Cavity
from emulator.geometry.facets import mean_normal
from emulator.geometry.fibres import nodal_depth
from emulator.geometry.mesh import Mesh
from emulator.geometry.tetrahedra import signed_volumes

_SMALL = 0.02  # offset of a centroid, relative to L, that makes a direction of its own


@dataclass(frozen=True, eq=False)
class Ventricle:
    """The wall of one ventricle; ``n`` nodes, of which all are corners.

    size : L in mm. axis : (3,) k. cavity, wall : volumes over L^3, which sum to one.
    offset : (n, 3) from the origin, over L. depth : (n,) 0 on the endocardium, 1 outside.
    normal : (n, 3). inner, held : (n,) bool, on the endocardium, without freedom.
    lean : (3,) g, shorter than one; zero in a body of revolution. volume : (n,) nodal, over L^3.
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
    volume: np.ndarray

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
        """Vectors (n, 7, 3) that turn with the body: n, c, k, x, k x x, g, k x g."""
        k, count = np.broadcast_to(self.axis, self.normal.shape), len(self.normal)
        lean = np.broadcast_to(self.lean, (count, 3))
        around = np.cross(self.axis, self.across)
        each = (self.normal, self.circumference, k, self.across, around, lean, np.cross(k, lean))
        return np.stack(each, axis=1)


def ventricle(mesh: Mesh, endocardium: str, held: np.ndarray) -> Ventricle:
    """The wall around the cavity ``endocardium`` of ``mesh``, whose nodes ``held`` (n,) are fixed.

    Raises
    ------
    InputError
        Quadratic elements; no base, or a rim of the cavity that is not in it.
    """
    if mesh.order != 1:
        raise InputError("its elements are quadratic; expected linear tetrahedra")
    surface = mesh.surface
    base = held[surface].all(axis=1)
    inside = mesh.facet_set(endocardium)
    inner = np.zeros(len(mesh.nodes), dtype=bool)
    inner[inside] = True
    rim = inner & held
    if not base.any() or not rim.any():
        raise InputError("it has no base: no facets held on all corners that meet the cavity")
    outer = np.zeros(len(mesh.nodes), dtype=bool)
    outer[surface[~base & ~_among(surface, inside)]] = True
    outer &= ~inner
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
        held=held,
        lean=centroid / np.hypot(np.linalg.norm(centroid), _SMALL),
        volume=nodal / size**3,
    )


def _among(facets: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which of ``facets`` (k, 3) are among ``others`` (l, 3), whatever their order, (k,)."""
    keys = {tuple(each) for each in np.sort(others, axis=1).tolist()}
    return np.array([tuple(each) in keys for each in np.sort(facets, axis=1).tolist()])
