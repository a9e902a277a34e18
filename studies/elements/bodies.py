"""Bodies, their kinds of elements, and what is measured on each."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

import emulator as em
from calibrate.measurements.location import gradients_at, locate
from emulator.core.errors import InputError
from emulator.geometry.discretisation import (
    from_quadrature_points,
    quadrature_points,
    shapes_at,
)
from emulator.geometry.facets import Cavity
from emulator.geometry.fibres import (
    Depth,
    from_nodes,
    nodal_depth,
    of_elements,
    turned,
    unit,
)
from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.geometry.mesh import Mesh
from emulator.geometry.refinement import to_linear, to_quadratic
from emulator.scenes.built_in.ventricles import HELIX
from emulator.scenes.fibre_rules import Helix
from emulator.scenes.scene import Scene


@dataclass(frozen=True)
class Body:
    """One of the bodies.

    corners : positions in the unit box besides the centre.
    reference : the finest scene. coarser : two scenes whose elements are twice and four times as
    long, for Richardson's extrapolation; none where the finest mesh stands for the limit.
    rungs : scenes by name, in the order of the table.
    """

    name: str
    corners: tuple[tuple[float, ...], ...]
    reference: Callable[[], Scene]
    coarser: tuple[Callable[[], Scene], ...]
    rungs: dict[str, Callable[[], Scene]]


# ---- the ventricle ------------------------------------------------------------------------------
def ventricle(*sizes: int, grading: float = 1.5, **changes: object) -> Scene:
    """The ventricle in quadratic elements, a fibre at each point."""
    return replace(em.scenes.left_ventricle(*sizes, grading=grading), **changes)


def of_elements_only(*sizes: int, **changes: object) -> Scene:
    """A fibre an element."""
    scene = ventricle(*sizes)
    return replace(scene, fibres=of_elements(scene.fibres), origin={}, **changes)


def _on_linear(mesh: Mesh) -> tuple[Mesh, Depth]:
    linear = to_linear(mesh)
    inside, outside = (np.unique(linear.facet_set(n)) for n in ("endocardium", "epicardium"))
    return linear, Depth(*nodal_depth(linear, inside, outside))


def of_nodes(*sizes: int) -> Scene:
    """A fibre at each corner, interpolated."""
    scene = ventricle(*sizes)
    linear, depth = _on_linear(scene.mesh)
    fibres = from_nodes(linear, turned(depth, HELIX, (0.0, 0.0, 1.0))[0], 2)
    return replace(scene, fibres=fibres, origin={})


def of_linear_depth(*sizes: int) -> Scene:
    """A fibre at each point, from a depth that is linear in an element."""
    scene = ventricle(*sizes)
    linear, depth = _on_linear(scene.mesh)
    at = quadrature_points(2)
    wall = Depth(
        np.einsum("qa,ma->mq", at, depth.value[linear.elements]),
        unit(np.einsum("qa,mai->mqi", at, depth.normal[linear.elements])),
    )
    return replace(scene, fibres=turned(wall, HELIX, (0.0, 0.0, 1.0))[0], origin={})


def straight(*sizes: int) -> Scene:
    """Quadratic elements with straight edges."""
    scene = ventricle(*sizes)
    mesh = to_quadratic(human_ventricle(*sizes, grading=1.5))
    return replace(scene, mesh=mesh, fibres=Helix(HELIX).directions(mesh)[0], origin={})


def linear(*sizes: int, **changes: object) -> Scene:
    """Linear elements."""
    return replace(em.scenes.left_ventricle(*sizes, order=1), origin={}, **changes)


_SOFT, _STIFF = (0.0, 0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0, 1.0, 0.0)
VENTRICLE = Body(
    "left_ventricle",
    (_SOFT, _STIFF, (0.0, 1.0, 0.0, 1.0, 1.0), (1.0, 0.0, 1.0, 0.0, 1.0)),
    lambda: ventricle(20, 40, 4),
    (lambda: ventricle(10, 20, 2), lambda: ventricle(5, 10, 1)),
    {
        "linear": lambda: linear(15, 30, 3),
        "linear, finer": lambda: linear(22, 44, 4),
        "linear, patches": lambda: linear(15, 30, 3, dilatation="patch"),
        "quadratic, 8 x 16 x 1": lambda: ventricle(8, 16, 1),
        "quadratic, 10 x 20 x 2": lambda: ventricle(10, 20, 2),
        "quadratic, rings even": lambda: ventricle(10, 20, 2, grading=1.0),
        "quadratic, straight": lambda: straight(10, 20, 2),
        "quadratic, mean dilatation": lambda: ventricle(10, 20, 2, dilatation="mean", origin={}),
        "quadratic, a fibre an element": lambda: of_elements_only(10, 20, 2),
        "quadratic, fibres of nodes": lambda: of_nodes(10, 20, 2),
        "quadratic, linear depth": lambda: of_linear_depth(10, 20, 2),
        "default": em.scenes.left_ventricle,
    },
)


# ---- bodies without fibres ------------------------------------------------------------------
def beam(*cells: int, **changes: object) -> Scene:
    """The beam in quadratic elements."""
    return replace(em.scenes.once_clamped_beam(cells), **changes)


def linear_beam(*cells: int, **changes: object) -> Scene:
    """The beam in linear elements."""
    return replace(em.scenes.once_clamped_beam(cells, order=1), origin={}, **changes)


_CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0))
BEAM = Body(
    "once_clamped_beam",
    _CORNERS,
    lambda: beam(40, 4, 4),
    (lambda: beam(20, 2, 2), lambda: beam(10, 1, 1)),
    {
        "linear": lambda: linear_beam(12, 4, 5),
        "linear, finer": lambda: linear_beam(24, 8, 10),
        "linear, patches": lambda: linear_beam(12, 4, 5, dilatation="patch"),
        "quadratic, 10 x 1 x 1": lambda: beam(10, 1, 1),
        "quadratic, mean dilatation": lambda: beam(10, 2, 2, dilatation="mean", origin={}),
        "quadratic, 10 x 2 x 2": lambda: beam(10, 2, 2),
        "default": em.scenes.once_clamped_beam,
    },
)

# The linear mesh's ligament is clamped by default; here it is elastic for all, so that the body
# is one.
_ELASTIC = {"ligament": 2.0, "clustering": 0.5, "ligament_shells": 5}
LIVER = Body(
    "liver",
    _CORNERS,
    lambda: em.scenes.liver(shells=10),
    (lambda: em.scenes.liver(shells=5),),
    {
        "linear": lambda: em.scenes.liver(shells=5, order=1, **_ELASTIC),
        "linear, finer": lambda: em.scenes.liver(shells=10, order=1, **_ELASTIC),
        "linear, patches": lambda: replace(
            em.scenes.liver(shells=10, order=1, **_ELASTIC), dilatation="patch", origin={}
        ),
        "default": em.scenes.liver,
    },
)

CUBE = Body(
    "twisting_cube",
    ((0.0, 0.0), (1.0, 1.0)),
    lambda: em.scenes.twisting_cube(cells=8),
    (lambda: em.scenes.twisting_cube(cells=4), lambda: em.scenes.twisting_cube(cells=2)),
    {
        "linear": lambda: em.scenes.twisting_cube(cells=6, order=1),
        "quadratic, 2 cells": lambda: em.scenes.twisting_cube(cells=2),
        "default": em.scenes.twisting_cube,
    },
)

BODIES = {body.name: body for body in (BEAM, CUBE, VENTRICLE, LIVER)}


# ---- what is measured -----------------------------------------------------------------------
@dataclass(frozen=True)
class Measured:
    """Displacements (t, d, 3) mm of landmarks, growth (t,) mL of the cavity, strains (t, d)."""

    landmarks: np.ndarray
    growth: np.ndarray | None
    strains: np.ndarray | None


def measured(scene: Scene, fields: np.ndarray, points: np.ndarray) -> Measured:
    """What ``fields`` (t, n, 3) mm mean at ``points`` (d, 3); NaN for points outside the mesh."""
    landmarks = np.full((len(fields), len(points), 3), np.nan)
    strains = np.full(landmarks.shape[:2], np.nan)
    for k, point in enumerate(points):
        try:
            elements, inside = locate(scene.mesh, point[None])
        except InputError:
            continue
        local = fields[:, scene.mesh.elements[elements[0]]]
        values, _ = shapes_at(scene.mesh.order, inside)
        landmarks[:, k] = np.einsum("a,tai->ti", values[0], local)
        if scene.fibres is not None:
            gradients = gradients_at(scene.mesh, elements, inside)
            weights = from_quadrature_points(scene.mesh.order, inside)[0]
            f = unit(weights @ scene.fibres_at_points[elements[0]])
            along = np.einsum("tai,aj,j->ti", local, gradients[0], f)
            strains[:, k] = along @ f + 0.5 * np.sum(along**2, axis=1)
    growth = None
    if "endocardium" in scene.mesh.facet_sets:
        cavity = Cavity(scene.mesh, "endocardium")
        growth = np.array([float(cavity(u[cavity.nodes])) - cavity.rest for u in fields])
    return Measured(landmarks, growth, None if scene.fibres is None else strains)
