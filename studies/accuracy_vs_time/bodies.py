"""The bodies: a scene, its meshes coarser and finer, and one fine enough to be the truth.

A finer mesh is another polyhedron, so displacements are compared at the same material points.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

import emulator as em
from emulator.geometry.bodies.ellipsoid import HUMAN, truncated_ellipsoid
from emulator.geometry.bodies.organ import organ
from emulator.geometry.fibres import rule_based_fibres
from emulator.geometry.quadratic import to_quadratic
from emulator.scenes import Scene
from emulator.scenes.left_ventricle import HELIX, left_ventricle
from emulator.scenes.supports import Support
from emulator.scenes.twisting_cube import twist


@dataclass(frozen=True)
class Body:
    """One body.

    scene : makes what emulators are of. shipped : an emulator of it, and a network alone;
    empty for none. meshes : other discretisations by name. truth : the finest.
    tests : theta. runs : FEM runs of series with discrepancy and of POD + GP.
    """

    scene: Callable[[], Scene]
    shipped: tuple[str, ...]
    meshes: dict[str, Callable[[], Scene]]
    truth: Callable[[], Scene]
    tests: int = 10
    runs: tuple[int, ...] = (5, 20, 60)
    reduced: tuple[int, ...] = (10, 30, 60)


def beam(cells: tuple[int, int, int], order: int = 1) -> Scene:
    """The once-clamped beam of other elements."""
    scene = em.scenes.once_clamped_beam(cells)
    return scene if order == 1 else replace(scene, mesh=to_quadratic(scene.mesh), origin={})


def cube(cells: int, order: int = 1) -> Scene:
    """The twisting cube of other elements; its supports are functions of position."""
    scene = em.scenes.twisting_cube(cells)
    if order == 1:
        return scene
    mesh = to_quadratic(scene.mesh)
    right = mesh.nodes[mesh.node_set("right")]
    turned = 0.5 * twist(right, np.full(3, 5.0), 60.0)
    supports = (Support("left"), Support("right", turned))
    return replace(scene, mesh=mesh, supports=supports, origin={})


def liver(shells: int, order: int = 1) -> Scene:
    """The liver of other elements."""
    scene = em.scenes.liver(shells)
    return (
        scene if order == 1 else replace(scene, mesh=to_quadratic(organ(shells=shells)), origin={})
    )


def ventricle(rings: int, around: int, layers: int, order: int = 1) -> Scene:
    """The left ventricle of other elements."""
    scene = left_ventricle(rings, around, layers)
    if order == 1:
        return scene
    mesh = truncated_ellipsoid(HUMAN, rings, around, layers, order)
    return replace(scene, mesh=mesh, fibres=rule_based_fibres(mesh, angles=HELIX), origin={})


_LINEAR_VENTRICLES = {
    "linear, coarser": lambda: ventricle(10, 20, 2),
    "linear, finer": lambda: ventricle(22, 44, 4),
    "quadratic, coarser": lambda: ventricle(8, 16, 1, order=2),
    "quadratic": lambda: ventricle(15, 30, 3, order=2),
}
BODIES = {
    "beam": Body(
        lambda: beam((12, 4, 5)),
        ("once_clamped_beam", "once_clamped_beam_pignn"),
        {
            "linear, coarser": lambda: beam((6, 2, 3)),
            "linear, finer": lambda: beam((24, 8, 10)),
            "linear, finest": lambda: beam((36, 12, 15)),
            "quadratic, coarser": lambda: beam((6, 2, 3), 2),
            "quadratic": lambda: beam((12, 4, 5), 2),
        },
        lambda: beam((24, 8, 10), 2),
    ),
    "cube": Body(
        lambda: cube(6),
        ("twisting_cube", "twisting_cube_pignn"),
        {
            "linear, coarser": lambda: cube(4),
            "linear, finer": lambda: cube(12),
            "quadratic, coarser": lambda: cube(3, 2),
            "quadratic": lambda: cube(6, 2),
        },
        lambda: cube(10, 2),
    ),
    "liver": Body(
        lambda: liver(6),
        ("liver", "liver_pignn"),
        # With other shells it is another body, held at more or less of it (README).
        {
            "linear, coarser": lambda: liver(4),
            "linear, finer": lambda: liver(12),
            "quadratic": lambda: liver(6, 2),
        },
        lambda: liver(9, 2),
    ),
    "ventricle": Body(
        em.scenes.left_ventricle,
        ("left_ventricle", "left_ventricle_pignn"),
        _LINEAR_VENTRICLES,
        lambda: ventricle(20, 40, 3, order=2),
    ),
    "fine ventricle": Body(
        lambda: ventricle(40, 80, 7),
        (),
        {},
        lambda: ventricle(20, 40, 3, order=2),
        tests=4,
        runs=(8,),
        reduced=(8,),
    ),
}


@cache
def scene_of(name: str) -> Scene:
    """The scene that a body's emulators are of."""
    return BODIES[name].scene()
