"""The bodies: a scene, its meshes coarser and finer, and one fine enough to be the truth.

A finer mesh of beam, cube or ventricle is made by the body's generator. For the liver and the
released bodies it is made by cutting the mesh's own tetrahedra in eight, so that it is the same
polyhedron, held at the same facets. Displacements are compared at the same material points.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from studies.accuracy_vs_time.refinement import quadratic, refined

import emulator as em
from emulator.geometry.bodies.ellipsoid import HUMAN, truncated_ellipsoid
from emulator.geometry.fibres import rule_based_fibres
from emulator.geometry.quadratic import to_quadratic
from emulator.released.scenes import published_scene
from emulator.scenes import Scene
from emulator.scenes.left_ventricle import HELIX, left_ventricle
from emulator.scenes.supports import Support
from emulator.scenes.twisting_cube import twist


@dataclass(frozen=True)
class Body:
    """One body.

    scene : makes what emulators are of. meshes : other discretisations by name. truth : the
    finest; none where there is none. shipped : an emulator of it, and a network alone; empty for
    none. model : whose released network is of this body; empty for none. tests : theta.
    tolerances : looser ones of FEM. orders : of series. runs, reduced : FEM runs of series with
    discrepancy and of POD + GP. calls : of each timing of FEM. fenics : whether FEniCSx solves it,
    too.
    """

    scene: Callable[[], Scene]
    truth: Callable[[], Scene] | None
    meshes: dict[str, Callable[[], Scene]]
    shipped: tuple[str, ...] = ()
    model: str = ""
    tests: int = 10
    tolerances: tuple[float, ...] = (1e-3, 1e-6)
    orders: tuple[int, ...] = (1, 2, 3)
    runs: tuple[int, ...] = (5, 20, 60)
    reduced: tuple[int, ...] = (10, 30, 60)
    calls: int = 5
    fenics: bool = False

    def has(self, stage: str) -> bool:
        """Whether the stage has rungs on this body."""
        asked = {
            "shipped": self.shipped,
            "released": self.model,
            "meshes": self.meshes,
            "float32": self.shipped or self.model,
            "FEniCSx": self.fenics,
        }
        return bool(asked.get(stage, True))


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


def ventricle(rings: int, around: int, layers: int, order: int = 1) -> Scene:
    """The left ventricle of other elements."""
    scene = left_ventricle(rings, around, layers)
    if order == 1:
        return scene
    mesh = truncated_ellipsoid(HUMAN, rings, around, layers, order)
    return replace(scene, mesh=mesh, fibres=rule_based_fibres(mesh, angles=HELIX), origin={})


BODIES = {
    "beam": Body(
        lambda: beam((12, 4, 5)),
        lambda: beam((24, 8, 10), 2),
        {
            "linear, coarser": lambda: beam((6, 2, 3)),
            "linear, finer": lambda: beam((24, 8, 10)),
            "linear, finest": lambda: beam((36, 12, 15)),
            "quadratic, coarser": lambda: beam((6, 2, 3), 2),
            "quadratic": lambda: beam((12, 4, 5), 2),
        },
        ("once_clamped_beam", "once_clamped_beam_pignn"),
        fenics=True,
    ),
    "cube": Body(
        lambda: cube(6),
        lambda: cube(10, 2),
        {
            "linear, coarser": lambda: cube(4),
            "linear, finer": lambda: cube(12),
            "quadratic, coarser": lambda: cube(3, 2),
            "quadratic": lambda: cube(6, 2),
        },
        ("twisting_cube", "twisting_cube_pignn"),
        fenics=True,
    ),
    "liver": Body(
        em.scenes.liver,
        lambda: quadratic(em.scenes.liver()),
        # No coarser one: of fewer shells it is another body, held at more of its surface.
        {"linear, finer": lambda: refined(em.scenes.liver())},
        ("liver", "liver_pignn"),
        tests=6,
    ),
    "ventricle": Body(
        em.scenes.left_ventricle,
        lambda: ventricle(20, 40, 3, order=2),
        {
            "linear, coarser": lambda: ventricle(10, 20, 2),
            "linear, finer": lambda: ventricle(22, 44, 4),
            "quadratic, coarser": lambda: ventricle(8, 16, 1, order=2),
            "quadratic": lambda: ventricle(15, 30, 3, order=2),
        },
        ("left_ventricle", "left_ventricle_pignn"),
        fenics=True,
    ),
    "fine ventricle": Body(
        lambda: ventricle(40, 80, 7),
        lambda: ventricle(20, 40, 3, order=2),
        {},
        tests=4,
        tolerances=(),
        orders=(3,),
        runs=(8,),
        reduced=(8,),
        calls=1,
    ),
}
_RELEASED: dict[str, tuple[str, Callable[[Scene], Scene] | None]] = {
    "released cube": ("TwistingBeam", lambda scene: quadratic(refined(scene))),
    "released liver": ("Liver", quadratic),
    # The released work of the pressure is no pressure's, and not defined on quadratic tetrahedra.
    "released ventricle": ("LeftVentricle", None),
}
NAMES = (*BODIES, *_RELEASED)


def find(name: str, published: Path | None) -> Body:
    """The body of that name; ``published`` is the folder of the released data."""
    if name in BODIES:
        return BODIES[name]
    if published is None:
        raise SystemExit(f"{name}: give --published DIR, the folder of the released data")
    model, finer = _RELEASED[name]
    return Body(
        lambda: published_scene(model, published),
        None if finer is None else lambda: finer(published_scene(model, published)),
        {},
        model=model,
        tests=4,
        tolerances=(),
        orders=(3,),
        runs=(20,),
        reduced=(30,),
    )


def is_released(name: str) -> bool:
    """Whether the body is of the released data."""
    return name in _RELEASED
