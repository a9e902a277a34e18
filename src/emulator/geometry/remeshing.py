r"""Even triangles on a cup-like surface, and triangles and tetrahedra by Gmsh (extra ``gmsh``).

A surface with one rim is mapped to the unit disc. The rim goes to the circle by its arc length;
every other point lies at the weighted mean of its neighbours,

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
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from emulator.core.errors import InputError
from emulator.geometry.mesh import cross_sides
from emulator.geometry.surfaces import Surface, one_rim, signed_areas

_TYPES = {3: 2, 4: 4}  # Gmsh's numbers of element types, by their corners


class Unmeshable(InputError):
    """Surfaces that cannot be meshed with edges of this length."""


def triangulate(
    loops: Sequence[np.ndarray], size: float | Callable[[float, float], float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 2) and triangles (t, 3) of a plane region between polygons.

    The polygons' corners, first and in their order, stay the only nodes on them.

    loops : (k, 2) corners in order, of the outer polygon and of those cut out of it.
    size : edge length inside, in the corners' unit, or a function of x and y.
    """
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
        geo.synchronize()
        if callable(size):
            gmsh.model.mesh.setSizeCallback(lambda _dim, _tag, x, y, _z, _size: size(x, y))
        else:
            gmsh.option.setNumber("Mesh.MeshSizeMin", size)
            gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.model.mesh.generate(2)
        places, triangles = _cells(gmsh, 3)
        return places[:, :2], triangles


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


def _cells(gmsh: Any, corners: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes in the order of their tags, those given first, and the elements."""
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


_HALVINGS = 30  # of an interval, until the middle of an edge is known to round-off


class DiscMap:
    """The map from the unit disc to a surface with one rim; :class:`InputError` for another number.

    surface : in mm. length : of its rim, mm. places : of its points in the disc, (n, 2).
    """

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        edges = one_rim(surface)
        successor = dict(edges.tolist())
        loop = [int(edges[0, 0])]
        while (next_one := successor[loop[-1]]) != loop[0]:
            loop.append(next_one)
        closed = surface.points[[*loop, loop[0]]]
        self._along = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))]
        )
        self._rim = closed
        self.length = float(self._along[-1])
        turn = 2.0 * np.pi * self._along[:-1] / self.length
        weights = _mean_value_weights(surface)
        self.places = np.zeros((len(surface.points), 2))
        self.places[loop] = np.column_stack([np.cos(turn), np.sin(turn)])
        free = np.setdiff1d(np.arange(len(surface.points)), loop)
        rows = (diags_array(weights.sum(axis=1)) - weights).tocsr()[free]
        self.places[free] = spsolve(rows[:, free].tocsc(), -(rows[:, loop] @ self.places[loop]))

    @cached_property
    def _inside(self) -> LinearNDInterpolator:
        return LinearNDInterpolator(self.places, self.surface.points)

    def rim_at(self, turn: np.ndarray) -> np.ndarray:
        """Return points (..., 3) mm of the rim at angles ``turn`` (...) of the circle."""
        along = np.mod(turn / (2.0 * np.pi), 1.0) * self.length
        return np.stack([np.interp(along, self._along, x) for x in self._rim.T], axis=-1)

    def at(self, places: np.ndarray) -> np.ndarray:
        """Return points (k, 3) mm of the surface at ``places`` (k, 2); off the disc, of the rim."""
        points = self._inside(places)
        off = np.isnan(points).any(axis=1)
        points[off] = self.rim_at(np.arctan2(places[off, 1], places[off, 0]))
        return points

    def remeshed(self, size: float) -> tuple[Surface, np.ndarray]:
        """Return triangles with edges of about ``size`` mm, and their points (n, 2) in the disc.

        Points of the rim come first, in its order.
        """
        count = max(6, round(self.length / size))
        turn = 2.0 * np.pi * np.arange(count) / count
        polygon = np.column_stack([np.cos(turn), np.sin(turn)])
        nearest, stretch = cKDTree(self.places, balanced_tree=False), self._stretch()
        places, rows = triangulate([polygon], lambda x, y: size / stretch[nearest.query((x, y))[1]])
        points = self.at(places)
        points[:count] = self.rim_at(turn)
        now, before = (
            np.sign(np.sum(signed_areas(corners)))
            for corners in (places[rows], self.places[self.surface.triangles])
        )
        rows = rows if now == before else rows[:, ::-1]
        return Surface(self.surface.name, points, rows), places

    def _stretch(self) -> np.ndarray:
        """Return lengths on the surface over those in the disc, (n,), from areas around points."""
        rows = self.surface.triangles
        on_surface = 0.5 * np.linalg.norm(cross_sides(self.surface.points[rows]), axis=1)
        areas = [
            np.bincount(rows.ravel(), np.repeat(each, 3), len(self.places))
            for each in (on_surface, np.abs(signed_areas(self.places[rows])))
        ]
        # Areas over two rings of neighbours, because rough surfaces have upright triangles.
        around = [np.bincount(rows.ravel(), each[rows].sum(1).repeat(3)) for each in areas]
        return np.sqrt(around[0] / np.maximum(around[1], 1e-30))

    def middles(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return points (k, 3) mm on the surface, equally far from both given places (k, 2).

        Along the straight line between them in the disc; between two places on the circle, along
        the rim.
        """
        first, last = self.at(one), self.at(other)
        low, high = np.zeros(len(one)), np.ones(len(one))
        for _ in range(_HALVINGS):
            share = 0.5 * (low + high)
            points = self.at(one + share[:, None] * (other - one))
            closer_to_first = np.sum((points - first) ** 2 - (points - last) ** 2, axis=1) < 0.0
            low = np.where(closer_to_first, share, low)
            high = np.where(closer_to_first, high, share)
        on_rim = np.all([np.linalg.norm(p, axis=1) > 1.0 - 1e-9 for p in (one, other)], axis=0)
        x, y = (one + other)[on_rim].T
        points[on_rim] = self.rim_at(np.arctan2(y, x))
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
