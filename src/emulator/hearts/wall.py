"""A wall of the heart meshed with tetrahedra, and measurements of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.core.units import IN_MM, MM3_PER_ML
from emulator.geometry.discretisation import MeshQuality, discretise, mesh_quality
from emulator.geometry.facets import Cavity
from emulator.geometry.mesh import SIDES, Mesh, find_rows, orient
from emulator.geometry.refinement import to_quadratic, unfolded
from emulator.hearts.remeshing import DiscMap, Remeshed, Unmeshable, tetrahedralise
from emulator.hearts.surfaces import Surface, place_of, read_surface

_EXTENTS = 4.0, 600.0  # mm; nobody's heart is smaller or larger, a mouse's being 7 mm long
_SMALLER = (
    1.0,
    0.93,
    0.86,
    0.78,
    0.7,
    0.5,
    0.35,
)  # of the size, tried in turn where a wall is too thin


class Thickness(NamedTuple):
    """Distance from the endocardium's points to the surface around them, mm."""

    least: float
    median: float
    most: float


@dataclass(frozen=True, eq=False)
class Wall:
    """A meshed wall, and measurements of it.

    mesh : facet and node sets of its surfaces and of the base, and a node set of one node for the
        apex of each surface, ``apex_endocardium``; at the surfaces' own place.
    axis : (3,) from apex to base, of length 1. base : (3,) mm, the middle of the cavity's rims.
    size : the target edge length, mm. thickness : the thickness of the wall.
    cavities : the volumes in mL within each endocardium, of the mesh and of the surface below the
        base plane. wall : those of the tissue.
    cut_off : the height in mm and the epicardium's volume in mL above the base plane.
    shift : the largest displacement in mm of a point of the surfaces.
    folded : the number of elements that were folded, and the largest displacement in mm of a node
        that unfolded them.
    warnings : what is doubtful, a line each.
    """

    mesh: Mesh
    axis: np.ndarray
    base: np.ndarray
    size: float
    thickness: Thickness
    cavities: Mapping[str, tuple[float, float]]
    wall: tuple[float, float]
    cut_off: tuple[float, float]
    shift: float
    folded: tuple[int, float]
    warnings: tuple[str, ...]
    quality: MeshQuality

    def local_thickness(self) -> np.ndarray:
        """Return the sum (n,) mm of the distances to the two nearest surfaces, at nodes."""
        nodes = self.mesh.nodes
        surfaces = (nodes[self.mesh.node_set(name)] for name in (*self.cavities, "epicardium"))
        ways = [cKDTree(points, balanced_tree=False).query(nodes)[0] for points in surfaces]
        return np.sort(ways, axis=0)[:2].sum(axis=0)

    def sentences(self) -> list[str]:
        """Return the measurements, a line each."""
        lines = [
            f"{len(self.mesh.nodes)} nodes, {len(self.mesh.elements)} tetrahedra of order "
            f"{self.mesh.order}, edges of {self.size:.3g} mm",
            f"long axis {place_of(self.axis)}, base at {place_of(self.base)} mm",
            f"wall {self.thickness.least:.3g} to {self.thickness.most:.3g} mm thick, "
            f"median {self.thickness.median:.3g}; {self.wall[0]:.4g} mL, {self.wall[1]:.4g} "
            "between the surfaces",
        ]
        for name, (cavity, volume) in self.cavities.items():
            of = "" if len(self.cavities) == 1 else f" of {name}"
            lines.append(
                f"cavity{of} {cavity:.4g} mL, the surface's own {volume:.4g} "
                f"({100 * (cavity / volume - 1):+.2f} %); over the wall {cavity / self.wall[0]:.3g}"
            )
        if self.cut_off[0] > 0.0:
            height, volume = self.cut_off
            lines.append(f"cut off {height:.3g} mm, {volume:.4g} mL, above the base plane")
        if self.shift > 0.0:
            lines.append(f"points of the surfaces were moved by {self.shift:.3g} mm at most")
        if self.folded[0]:
            lines.append(
                f"{self.folded[0]} curved elements were folded, and straightened: nodes on their "
                f"edges moved by {self.folded[1]:.2g} mm at most"
            )
        return [*lines, *self.warnings, self.quality.sentence()]


def measured(
    before: Mesh,
    surfaces: Sequence[Surface],
    *,
    axis: np.ndarray,
    base: np.ndarray,
    size: float,
    thickness: Thickness,
    shift: float,
    cut_off: tuple[float, float] = (0.0, 0.0),
) -> Wall:
    """Unfold a mesh and return it as a wall, measured beside its surfaces, the epicardium last.

    Parameters
    ----------
    before : the mesh, which may be curved so much that it folds.
    surfaces : what it was made from, named as its facet sets.
    axis, base, size, thickness, shift, cut_off : see :class:`Wall`.
    """
    mesh, folded = unfolded(before) if before.order == 2 else (before, 0)
    *cavities, whole = (surface.volume / MM3_PER_ML for surface in surfaces)
    named = zip(surfaces, cavities, strict=False)
    return Wall(
        mesh=mesh,
        axis=axis,
        base=base,
        size=size,
        thickness=thickness,
        cavities={s.name: (Cavity(mesh, s.name).rest, volume) for s, volume in named},
        wall=(float(discretise(mesh).weights.sum()) / MM3_PER_ML, whole - sum(cavities)),
        cut_off=cut_off,
        shift=shift,
        folded=(folded, farthest(mesh.nodes, before.nodes)),
        warnings=(),
        quality=mesh_quality(mesh),
    )


def farthest(*points: np.ndarray) -> float:
    """Return the largest distance in mm between points (n, 3) of each pair of arrays."""
    pairs = zip(points[::2], points[1::2], strict=True)
    return float(max(np.linalg.norm(one - other, axis=1).max() for one, other in pairs))


def surface_in_mm(source: str | Path | Surface, name: str, unit: str) -> Surface:
    """Return a surface under ``name``, or that of a file in ``unit``, of a heart's size."""
    if isinstance(source, Surface):
        surface = replace(source, name=name)
    else:
        surface = read_surface(source, name, IN_MM[unit])
    low, high = _EXTENTS
    if not low <= surface.extent <= high:
        size = surface.extent / IN_MM[unit]
        fitting = [name for name, factor in IN_MM.items() if low <= factor * size <= high]
        raise InputError(
            f"{name}: it is {surface.extent:.3g} mm from corner to corner, lengths being taken as "
            f"{unit}: give the file's own --unit, {' or '.join(fitting) or ', '.join(IN_MM)}"
        )
    return surface


def thickness_of(ways: np.ndarray) -> Thickness:
    """Return the least, median and largest of distances (n,) mm."""
    return Thickness(float(ways.min()), float(np.median(ways)), float(ways.max()))


def mesh_that_fits(
    make: Callable[[float], Mesh],
    thickness: Thickness,
    size: float | None,
    usual: float,
    extent: float,
) -> tuple[float, Mesh]:
    """Return the edges of the first mesh that can be made, and the mesh.

    Parameters
    ----------
    make : ``make(size)``, which raises :class:`Unmeshable` where the wall is too thin for it.
    thickness : the wall's thickness.
    size, usual : the edge length in mm that was asked for, and the one to take if None was.
    extent : the extent of the epicardium, mm.
    """
    target = usual if size is None else size
    if not 0.0 < target < extent / 4.0:
        raise InputError(
            f"--size {target} mm: expected edges above 0 and below a quarter of the epicardium's "
            f"extent, {extent:.4g} mm"
        )
    for smaller in _SMALLER:
        try:
            length, mesh = smaller * target, make(smaller * target)
        except Unmeshable as error:
            reason = error
            continue
        if size is not None and length < size:
            raise InputError(
                f"the wall, {thickness.least:.3g} mm where it is thinnest, is too thin for edges "
                f"of {size:.3g} mm: --size {length:.4g} fits"
            )
        return float(length), mesh
    raise InputError(
        f"{reason}, nor with edges of {target:.3g} mm or any between: move the surfaces apart "
        "there, or smooth them, --smooth 20"
    ) from reason


def fill(
    maps: Sequence[DiscMap],
    new: Sequence[Remeshed],
    joints: Mapping[str, np.ndarray],
    more: np.ndarray,
    axis: np.ndarray,
    size: float,
    order: int,
) -> Mesh:
    """Mesh the space between surfaces and the joints of their rims with tetrahedra.

    Parameters
    ----------
    maps, new : the surfaces, and even triangles on them, which name the facet sets; their points
        are numbered one surface after the other.
    joints : the triangles (t, 3) of each joint.
    more : points (k, 3) mm of the joints besides those on rims, numbered after all others.
    axis : (3,) from apex to base.
    size : the longest edge aimed at inside, mm.
    order : of the elements; edges of quadratic ones follow the surfaces.
    """
    surfaces = [triangulation.surface for triangulation in new]
    first = np.cumsum([0, *(len(surface.points) for surface in surfaces)])[:-1]
    rows = [surface.triangles + start for surface, start in zip(surfaces, first, strict=True)]
    facets = {surface.name: faces for surface, faces in zip(surfaces, rows, strict=True)}
    facets |= joints
    points = np.vstack([*(surface.points for surface in surfaces), more])
    nodes, elements = tetrahedralise(points, np.concatenate([*facets.values()]), size)
    sets = {name: np.unique(triangles) for name, triangles in facets.items()}
    for surface in surfaces:
        on_it = sets[surface.name]
        sets[f"apex_{surface.name}"] = on_it[[np.argmin(nodes[on_it] @ axis)]]
    mesh = Mesh(nodes, orient(nodes, elements), sets, facets)
    if order == 1:
        return mesh

    def midpoints(edges: np.ndarray) -> np.ndarray:
        middle = mesh.nodes[edges].mean(axis=1)
        for triangles, disc_map, triangulation, start in zip(rows, maps, new, first, strict=True):
            on = find_rows(edges, triangles[:, SIDES].reshape(-1, 2)) >= 0
            middle[on] = disc_map.middles(triangulation, edges[on] - start)
        return middle

    return to_quadratic(mesh, midpoints)
