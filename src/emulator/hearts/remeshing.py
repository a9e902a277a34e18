r"""Even triangles on a cup-like surface, and triangles and tetrahedra by Gmsh (extra ``gmsh``).

A surface is mapped to the unit disc. Its longest rim goes to the circle by its arc length; other
openings are filled by fans for the map. Every other point lies at the weighted mean of its
neighbours,

.. math:: \sum_j w_{ij} (u_j - u_i) = 0, \qquad
          w_{ij} = \frac{\tan(\alpha_{ij}/2) + \tan(\beta_{ij}/2)}{|x_j - x_i|},

with the angles at :math:`x_i` on both sides of the edge: mean value coordinates (Floater 2003, Mean
value coordinates, Computer Aided Geometric Design 20). The weights are positive and the disc is
convex, so that no triangle turns over, whatever its shape (Tutte 1963). They come close to those of
a conformal map, so triangles with edges :math:`h / s`, even in the disc, are even on the surface,
where lengths are :math:`s` times those in the disc.

Gmsh runs on one thread with its own fixed random seed, so that a mesh is the same each time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.mesh import cross_sides
from emulator.hearts.surfaces import Surface, closed, rim_loops

_TYPES = {3: 2, 4: 4}  # Gmsh's numbers of element types, by their corners


class Unmeshable(InputError):
    """Surfaces that cannot be meshed with edges of this length."""


def triangulate(
    loops: Sequence[np.ndarray],
    size: float | Callable[[float, float], float],
    *,
    filled: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 2) and triangles (t, 3) of a plane region between polygons.

    The polygons' corners, first and in their order, stay the only nodes on them.

    loops : (k, 2) corners in order, of the outer polygon and of those cut out of it.
    size : edge length inside, in the corners' unit, or a function of x and y.
    filled : whether what is cut out is meshed, too.
    """
    _check_polygons(loops)
    with _model() as gmsh:
        geo, rings, first = gmsh.model.geo, [], 1
        for loop in loops:
            tags = range(first, first + len(loop))
            for tag, (x, y) in zip(tags, loop.tolist(), strict=True):
                geo.addPoint(x, y, 0.0, 0.0, tag)
            for tag in tags:
                geo.addLine(tag, tag + 1 if tag + 1 in tags else first, tag)
                geo.mesh.setTransfiniteCurve(tag, 2)
            rings.append(geo.addCurveLoop(list(tags)))
            first += len(loop)
        geo.addPlaneSurface(rings)
        for ring in rings[1:] if filled else ():
            geo.addPlaneSurface([ring])
        geo.synchronize()
        if callable(size):
            gmsh.model.mesh.setSizeCallback(lambda _dim, _tag, x, y, _z, _size: size(x, y))
        else:
            gmsh.option.setNumber("Mesh.MeshSizeMin", size)
            gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.model.mesh.generate(2)
        places, triangles = _cells(gmsh, 3)
        return places[:, :2], triangles


def _check_polygons(loops: Sequence[np.ndarray]) -> None:
    """Raise :class:`Unmeshable` unless no polygon crosses another, and the first is around them."""
    starts = np.concatenate([np.asarray(loop) for loop in loops])
    ends = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])

    def side(points: np.ndarray) -> np.ndarray:
        """Return the side of each edge (e,) that points (e', 2) lie on, (e, e')."""
        along, to = (ends - starts)[:, None], points[None] - starts[:, None]
        return np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    apart = side(starts) * side(ends) < 0.0
    if (apart & apart.T).any():
        raise Unmeshable("two rims cross")
    for loop in loops[1:]:
        if not within(loop[:1], loops[0])[0]:
            raise Unmeshable("a rim is outside of the one around it")


def within(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Return whether each of points (d, 2) lies within a polygon (k, 2), (d,) bool.

    A ray along x crosses the sides an odd number of times.
    """
    (x, y), (a, b) = points.T[..., None], (polygon, np.roll(polygon, -1, axis=0))
    above = (a[:, 1] > y) != (b[:, 1] > y)
    steps = np.where(above, b[:, 1] - a[:, 1], 1.0)
    crossed = above & (x < a[:, 0] + (y - a[:, 1]) / steps * (b[:, 0] - a[:, 0]))
    return crossed.sum(axis=1) % 2 == 1


def tetrahedralise(
    points: np.ndarray, triangles: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n', 3) mm and elements (m, 4) within a closed surface, whose triangles stay.

    points, triangles : (n, 3) mm, the first nodes in their order, and (t, 3), in any sense.
    size : longest edge aimed at inside, mm.
    """
    with _model() as gmsh:
        skin = gmsh.model.addDiscreteEntity(2)
        tags = np.arange(1, len(points) + 1)
        gmsh.model.mesh.addNodes(2, skin, tags, points.ravel())
        gmsh.model.mesh.addElementsByType(skin, _TYPES[3], [], (triangles + 1).ravel())
        gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop([skin])])
        gmsh.model.geo.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.OptimizeNetgen", 1)
        gmsh.model.mesh.generate(3)
        return _cells(gmsh, 4)


def tetrahedralise_anew(
    points: np.ndarray, triangles: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n', 3) mm and elements (m, 4) within a closed surface, with new triangles.

    Gmsh cuts the surface into patches that it can lay out in a plane, and meshes these evenly.

    points, triangles : (n, 3) mm and (t, 3), normals pointing out. size : edge length, mm.
    """
    with _model() as gmsh:
        skin = gmsh.model.addDiscreteEntity(2)
        gmsh.model.mesh.addNodes(2, skin, np.arange(1, len(points) + 1), points.ravel())
        gmsh.model.mesh.addElementsByType(skin, _TYPES[3], [], (triangles + 1).ravel())
        gmsh.model.mesh.classifySurfaces(np.pi, True, True, np.pi)
        gmsh.model.mesh.createGeometry()
        patches = [tag for _, tag in gmsh.model.getEntities(2)]
        gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop(patches)])
        gmsh.model.geo.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMin", size)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.OptimizeNetgen", 1)
        gmsh.model.mesh.generate(3)
        return _cells(gmsh, 4)


def _cells(gmsh: Any, corners: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes in the order of their tags, and the elements; input nodes come first."""
    tags, places, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(tags)
    _, rows = gmsh.model.mesh.getElementsByType(_TYPES[corners])
    if not len(rows):
        raise Unmeshable("gmsh found no elements")
    elements = np.searchsorted(tags[order], rows).reshape(-1, corners)
    return places.reshape(-1, 3)[order], elements


@contextmanager
def _model() -> Iterator[Any]:
    """Yield Gmsh with an empty model; its errors become :class:`InputError`."""
    try:
        gmsh = import_module("gmsh")
    except ModuleNotFoundError as error:
        if error.name != "gmsh":
            raise
        raise InputError("meshing needs gmsh: pip install 'soft-tissue-calibrate[gmsh]'") from error
    except OSError as error:  # ctypes, of a library that is not on this machine
        raise InputError(
            f"gmsh is installed but does not load ({error}): it needs the system's OpenGL and X11 "
            "libraries, without a display; on Debian apt install libgl1 libglu1-mesa libxcursor1 "
            "libxinerama1 libxft2 libgomp1"
        ) from error
    owns_session = not gmsh.isInitialized()
    if owns_session:
        gmsh.initialize(readConfigFiles=False, interruptible=False)
    previous_model = None if owns_session else gmsh.model.getCurrent()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        gmsh.model.add("soft tissue")
        yield gmsh
    except InputError:
        raise
    except Exception as error:  # Gmsh raises no other type
        reason = " ".join(str(error).split())[:160]
        raise Unmeshable(f"gmsh could not mesh it: {reason}") from error
    finally:
        if owns_session:
            gmsh.finalize()
        else:
            gmsh.model.remove()
            gmsh.model.setCurrent(previous_model)


_ROUGH = 0.15  # share of the enclosed volume that even triangles may miss
_HALVINGS = 30  # of an interval, until the middle of an edge is known to round-off


class Remeshed(NamedTuple):
    """Even triangles on a surface.

    surface : the triangles. places : their points (n, 2) in the disc.
    counts : the number of points of each rim, at even shares of its length; they come first, rim
        by rim and in order.
    """

    surface: Surface
    places: np.ndarray
    counts: tuple[int, ...]

    @property
    def loops(self) -> list[np.ndarray]:
        """The points (k,) of each rim, in order."""
        ends = np.cumsum(self.counts)
        return [np.arange(end - count, end) for end, count in zip(ends, self.counts, strict=True)]


class Rim(NamedTuple):
    """A rim as a closed curve: its first point stands at its end, too.

    along : the length (k + 1,) up to each point, over the whole. points : (k + 1, 3) mm.
    places : (k + 1, 2) in the disc. length : of the whole, mm.
    """

    along: np.ndarray
    points: np.ndarray
    places: np.ndarray
    length: float

    def at(self, turn: np.ndarray) -> np.ndarray:
        """Return points (..., 3) mm at shares ``turn`` (...) of the length."""
        return self._between(self.points, turn)

    def place(self, turn: np.ndarray) -> np.ndarray:
        """Return places (..., 2) in the disc at shares ``turn`` (...) of the length."""
        return self._between(self.places, turn)

    def _between(self, values: np.ndarray, turn: np.ndarray) -> np.ndarray:
        share = np.mod(turn, 1.0)
        return np.stack([np.interp(share, self.along, x) for x in values.T], axis=-1)


class DiscMap:
    """The map from the unit disc to a surface; :class:`InputError` for a closed one.

    Its longest rim is the circle. Other rims are holes in the disc.

    surface : in mm. places : of its points in the disc, (n, 2). rims : the longest one first.
    """

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        loops = rim_loops(surface)
        if not loops:
            raise InputError(f"{surface.name}: it is closed; only a surface with a rim is mapped")
        whole = closed(surface, loops[1:])
        curves = [surface.points[[*loop, loop[0]]] for loop in loops]
        steps = [np.linalg.norm(np.diff(curve, axis=0), axis=1) for curve in curves]
        along = [np.concatenate([[0.0], np.cumsum(lengths)]) for lengths in steps]
        turn = 2.0 * np.pi * along[0][:-1] / along[0][-1]
        places = np.zeros((len(whole.points), 2))
        places[loops[0]] = np.column_stack([np.cos(turn), np.sin(turn)])
        weights = _mean_value_weights(whole)
        free = np.setdiff1d(np.arange(len(whole.points)), loops[0])
        rows = (diags_array(weights.sum(axis=1)) - weights).tocsr()[free]
        places[free] = spsolve(rows[:, free].tocsc(), -(rows[:, loops[0]] @ places[loops[0]]))
        self._whole, self._places = whole, places
        self.places = places[: len(surface.points)]
        self.rims = [
            Rim(s / s[-1], points, places[[*loop, loop[0]]], float(s[-1]))
            for s, points, loop in zip(along, curves, loops, strict=True)
        ]

    @cached_property
    def _inside(self) -> LinearNDInterpolator:
        return LinearNDInterpolator(self._places, self._whole.points)

    def at(self, places: np.ndarray) -> np.ndarray:
        """Return points (k, 3) mm of the surface at ``places`` (k, 2); off the disc, of the rim."""
        points = self._inside(places)
        off = np.isnan(points).any(axis=1)
        angles = np.arctan2(places[off, 1], places[off, 0])
        points[off] = self.rims[0].at(angles / (2.0 * np.pi))
        return points

    def remeshed(self, size: float) -> Remeshed:
        """Return triangles with edges of about ``size`` mm."""
        counts = [max(6, round(rim.length / size)) for rim in self.rims]
        turns = [np.arange(count) / count for count in counts]
        circle = 2.0 * np.pi * turns[0]
        polygons = [np.column_stack([np.cos(circle), np.sin(circle)])]
        polygons += [rim.place(turn) for rim, turn in zip(self.rims[1:], turns[1:], strict=True)]
        nearest, stretch = cKDTree(self.places, balanced_tree=False), self._stretch()
        places, rows = triangulate(polygons, lambda x, y: size / stretch[nearest.query((x, y))[1]])
        points = self.at(places)
        on_rims = [rim.at(turn) for rim, turn in zip(self.rims, turns, strict=True)]
        points[: sum(counts)] = np.concatenate(on_rims)
        now, before = (
            np.sign(np.sum(_signed_areas(corners)))
            for corners in (places[rows], self.places[self.surface.triangles])
        )
        rows = rows if now == before else rows[:, ::-1]
        new = Surface(self.surface.name, points, rows)
        missed = abs(new.volume / self.surface.volume - 1.0)
        if not missed < _ROUGH:
            raise Unmeshable(
                f"{self.surface.name}: even triangles with edges of {size:.3g} mm miss "
                f"{100.0 * missed:.0f} % of what it encloses; its openings are narrow, "
                f"the longest rim being of {self.rims[0].length:.3g} mm"
            )
        return Remeshed(new, places, tuple(counts))

    def _stretch(self) -> np.ndarray:
        """Return lengths on the surface over those in the disc, (n,), from areas around points."""
        rows = self.surface.triangles
        on_surface = 0.5 * np.linalg.norm(cross_sides(self.surface.points[rows]), axis=1)
        areas = [
            np.bincount(rows.ravel(), np.repeat(area, 3), len(self.places))
            for area in (on_surface, np.abs(_signed_areas(self.places[rows])))
        ]
        # Areas over two rings of neighbours, because rough surfaces have upright triangles.
        around = [np.bincount(rows.ravel(), area[rows].sum(1).repeat(3)) for area in areas]
        return np.sqrt(around[0] / np.maximum(around[1], 1e-30))

    def middles(self, new: Remeshed, edges: np.ndarray) -> np.ndarray:
        """Return points (k, 3) mm on the surface, equally far from both ends of ``edges`` (k, 2).

        Along the straight line between them in the disc; between neighbours on a rim, along it.
        """
        one, other = new.places[edges[:, 0]], new.places[edges[:, 1]]
        first, last = self.at(one), self.at(other)
        low, high = np.zeros(len(one)), np.ones(len(one))
        for _ in range(_HALVINGS):
            share = 0.5 * (low + high)
            points = self.at(one + share[:, None] * (other - one))
            closer_to_first = np.sum((points - first) ** 2 - (points - last) ** 2, axis=1) < 0.0
            low = np.where(closer_to_first, share, low)
            high = np.where(closer_to_first, high, share)
        for rim, loop in zip(self.rims, new.loops, strict=False):
            count = len(loop)
            a, b = (edges - loop[0]).T
            on_it = ((edges >= loop[0]) & (edges <= loop[-1])).all(axis=1)
            on_it &= np.isin(np.abs(a - b), (1, count - 1))
            start = np.where(np.abs(a - b) == 1, np.minimum(a, b), count - 1)
            points[on_it] = rim.at((start[on_it] + 0.5) / count)
        return points


def _mean_value_weights(surface: Surface) -> coo_array:
    """Return the weights (n, n) of each point's neighbours."""
    x, rows = surface.points, surface.triangles
    first, last, values = [], [], []
    for a, b, c in (rows.T, rows.T[[1, 2, 0]], rows.T[[2, 0, 1]]):
        u, v = x[b] - x[a], x[c] - x[a]
        p, q = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
        # tan(angle / 2) = |u x v| / (|u| |v| + u . v), kept above zero in slivers
        half = np.linalg.norm(np.cross(u, v), axis=1) / (p * q + np.einsum("ti,ti->t", u, v))
        half = np.clip(half, 1e-3, 1e3)
        first += [a, a]
        last += [b, c]
        values += [half / p, half / q]
    places = (np.concatenate(first), np.concatenate(last))
    return coo_array((np.concatenate(values), places), shape=(len(x), len(x))).tocsr()


def _signed_areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas (t,) of triangles (t, 3, 2) in the plane, positive anticlockwise."""
    (ux, uy), (vx, vy) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return 0.5 * (ux * vy - uy * vx)
