"""Triangles and tetrahedra by Gmsh, which is an optional dependency (extra ``gmsh``).

One thread and Gmsh's own fixed random seed, so that a mesh is the same each time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np

from emulator.core.errors import InputError

_TRIANGLE, _TETRAHEDRON = 2, 4  # Gmsh's numbers of element types


def triangulate(
    loops: Sequence[np.ndarray], size: float | Callable[[float, float], float]
) -> tuple[np.ndarray, np.ndarray]:
    """A plane region between polygons, whose corners stay the only nodes on them.

    Parameters
    ----------
    loops : (k, 2) corners in order, of the outer polygon and of those cut out of it.
    size : edge length inside, in the corners' unit, or a function of x and y.

    Returns
    -------
    Points (n, 2), the loops' corners first and in their order, and triangles (t, 3).
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
        return _cells(gmsh, _TRIANGLE, 3, 2)


def tetrahedralise(
    points: np.ndarray, triangles: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """The space within a closed surface, whose triangles stay.

    Parameters
    ----------
    points, triangles : (n, 3) mm and (t, 3), in any sense.
    size : longest edge aimed at inside, mm.

    Returns
    -------
    Nodes (n', 3) mm, the surface's points first and in their order, and elements (m, 4).
    """
    with _model() as gmsh:
        skin = gmsh.model.addDiscreteEntity(2)
        tags = np.arange(1, len(points) + 1)
        gmsh.model.mesh.addNodes(2, skin, tags, points.ravel())
        gmsh.model.mesh.addElementsByType(skin, _TRIANGLE, [], (triangles + 1).ravel())
        gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop([skin])])
        gmsh.model.geo.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.OptimizeNetgen", 1)
        gmsh.model.mesh.generate(3)
        return _cells(gmsh, _TETRAHEDRON, 4, 3)


def _cells(gmsh: Any, kind: int, corners: int, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in the order of their tags, which are those given first, and elements."""
    tags, places, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(tags)
    _, rows = gmsh.model.mesh.getElementsByType(kind)
    if not len(rows):
        raise InputError("gmsh found no elements")
    used = np.searchsorted(tags[order], rows).reshape(-1, corners)
    return places.reshape(-1, 3)[order][:, :dimension], used


@contextmanager
def _model() -> Iterator[Any]:
    """Gmsh with an empty model; its errors as :class:`InputError`."""
    gmsh = _gmsh()
    started = not gmsh.isInitialized()
    if started:
        gmsh.initialize(readConfigFiles=False, interruptible=False)
    before = None if started else gmsh.model.getCurrent()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        gmsh.model.add("soft tissue")
        yield gmsh
    except InputError:
        raise
    except Exception as error:  # Gmsh raises no other type
        said = " ".join(str(error).split())[:160]
        raise InputError(f"gmsh could not mesh it: {said}") from error
    finally:
        if started:
            gmsh.finalize()
        else:
            gmsh.model.remove()
            gmsh.model.setCurrent(before)


def _gmsh() -> Any:
    try:
        return import_module("gmsh")
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
