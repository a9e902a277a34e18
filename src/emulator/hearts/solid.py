"""A body within one closed surface, such as an organ's, meshed with tetrahedra by Gmsh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.core.units import IN_MM, MM3_PER_ML
from emulator.geometry.discretisation import MeshQuality, discretise, mesh_quality
from emulator.geometry.mesh import SIDES, Mesh, boundary_facets, find_rows, orient
from emulator.geometry.refinement import to_quadratic, unfolded
from emulator.hearts.remeshing import Unmeshable, tetrahedralise_anew
from emulator.hearts.surfaces import Surface, smoothed
from emulator.hearts.wall import farthest, surface_in_mm

_ELEMENTS = 2500  # of the default size: some 5000 quadratic nodes
_REGULAR = np.sqrt(2.0) / 12.0  # volume of a regular tetrahedron with edges of 1
_SMALLER = (1.0, 0.7, 0.5)  # of the default size, tried in turn


@dataclass(frozen=True, eq=False)
class Solid:
    """A meshed body, and measurements of it.

    mesh : the tetrahedra; all of their surface is the facet set ``surface``.
    size : the target edge length, mm. volumes : mL, of the mesh and within the surface.
    folded : the number of elements that were folded, and the largest displacement in mm of a node
        that unfolded them.
    """

    mesh: Mesh
    size: float
    volumes: tuple[float, float]
    folded: tuple[int, float]
    quality: MeshQuality

    def sentences(self) -> list[str]:
        """Return the measurements, a line each."""
        volume, enclosed = self.volumes
        lines = [
            f"{len(self.mesh.nodes)} nodes, {len(self.mesh.elements)} tetrahedra of order "
            f"{self.mesh.order}, edges of {self.size:.3g} mm",
            f"volume {volume:.4g} mL, the surface's own {enclosed:.4g} "
            f"({100 * (volume / enclosed - 1):+.2f} %)",
        ]
        if self.folded[0]:
            lines.append(
                f"{self.folded[0]} curved elements were folded, and straightened: nodes on their "
                f"edges moved by {self.folded[1]:.2g} mm at most"
            )
        return [*lines, self.quality.sentence()]


def mesh_solid(
    source: str | Path | Surface,
    *,
    size: float | None = None,
    order: int = 2,
    smooth: int = 0,
    unit: str = "mm",
) -> Solid:
    """Mesh the body within a closed surface.

    Parameters
    ----------
    source : the file of triangles, or the surface in mm.
    size : the edge length, mm; by default for some 2500 elements.
    order : 2 for quadratic elements with curved edges on the surface, or 1.
    smooth : times of Taubin's filter on the surface.
    unit : the unit of the file, ``mm``, ``cm``, ``m`` or ``um``.

    Raises
    ------
    InputError
        A surface that is open, or that :func:`~emulator.hearts.surfaces.surface` refuses; no Gmsh;
        or edges that are too long for the surface.
    """
    look_up(IN_MM, unit, "unit")
    if order not in (1, 2) or smooth < 0:
        raise InputError(f"order {order}, smooth {smooth}: expected order 1 or 2, smooth 0 or more")
    skin = smoothed(surface_in_mm(source, "surface", unit), smooth)
    if skin.rims:
        raise InputError(
            f"surface: it is open, with {len(skin.rims)} rims; expected it closed around the body"
        )
    if size is not None and not 0.0 < size < skin.extent / 4.0:
        raise InputError(
            f"--size {size} mm: expected edges above 0 and below a quarter of the body's extent, "
            f"{skin.extent:.4g} mm"
        )
    usual = float(np.cbrt(skin.volume / (_ELEMENTS * _REGULAR)))
    for length in [usual * share for share in _SMALLER] if size is None else [size]:
        try:
            before = _within(skin, length, order)
            break
        except Unmeshable as error:
            reason = error
    else:
        raise InputError(f"{reason}; give shorter edges, --size, or --smooth 20") from reason
    mesh, folded = unfolded(before) if order == 2 else (before, 0)
    return Solid(
        mesh,
        length,
        (float(discretise(mesh).weights.sum()) / MM3_PER_ML, skin.volume / MM3_PER_ML),
        (folded, farthest(mesh.nodes, before.nodes)),
        mesh_quality(mesh),
    )


def _within(skin: Surface, size: float, order: int) -> Mesh:
    """Return tetrahedra within a closed surface; edges of quadratic ones follow it."""
    points, rows = tetrahedralise_anew(skin.points, skin.triangles, size)
    used, elements = np.unique(rows, return_inverse=True)
    nodes = points[used]
    elements = orient(nodes, elements.reshape(-1, 4))
    facets = boundary_facets(elements)
    mesh = Mesh(nodes, elements, {"surface": np.unique(facets)}, {"surface": facets})
    if shape := mesh_quality(mesh).flat:
        raise Unmeshable(f"{shape} elements with edges of {size:.3g} mm would be flat")
    if order == 1:
        return mesh

    def midpoints(edges: np.ndarray) -> np.ndarray:
        middle = mesh.nodes[edges].mean(axis=1)
        on = find_rows(edges, facets[:, SIDES].reshape(-1, 2)) >= 0
        middle[on] = skin.nearest(middle[on])[0]
        return middle

    return to_quadratic(mesh, midpoints)
