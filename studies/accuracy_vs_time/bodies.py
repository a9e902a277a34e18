"""The bodies: a scene, its meshes coarser and finer, and one fine enough to be the truth.

A finer mesh of beam, cube or ventricle is made by the body's generator. For the liver and the
released bodies it is made by cutting the mesh's own tetrahedra in eight, so that it is the same
polyhedron, held at the same facets. Displacements are compared at the same material points.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from studies.accuracy_vs_time.refinement import quadratic, refined

import emulator as em
from emulator.released.scenes import published_scene
from emulator.scenes import Scene


@dataclass(frozen=True)
class Body:
    """One body.

    scene : makes what emulators are of. meshes : other discretisations by name. truth : the
    finest; none where there is none. network : a shipped one of it; empty for none. model : whose
    released network is of this body; empty for none. tests : theta. tolerances : looser ones of
    FEM. orders : of series. runs, reduced : FEM runs of series with discrepancy and of POD + GP.
    calls : of each timing of FEM. fenics : whether FEniCSx solves it, too.
    """

    scene: Callable[[], Scene]
    truth: Callable[[], Scene] | None
    meshes: dict[str, Callable[[], Scene]]
    network: str = ""
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
            "shipped": self.network,
            "released": self.model,
            "meshes": self.meshes,
            "float32": self.network or self.model,
            "FEniCSx": self.fenics,
        }
        return bool(asked.get(stage, True))


def beam(cells: tuple[int, int, int], order: int = 1) -> Scene:
    """The once-clamped beam of other elements."""
    return em.scenes.once_clamped_beam(cells, order=order)


def cube(cells: int, order: int = 1) -> Scene:
    """The twisting cube of other elements."""
    return em.scenes.twisting_cube(cells, order=order)


def ventricle(rings: int, around: int, layers: int, order: int = 1) -> Scene:
    """The left ventricle of other elements."""
    return em.scenes.left_ventricle(rings, around, layers, order=order, grading=1.0)


def liver() -> Scene:
    """The liver of linear elements, clamped at its ligament."""
    return em.scenes.liver(order=1)


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
        "once_clamped_beam_pignn",
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
        "twisting_cube_pignn",
        fenics=True,
    ),
    "liver": Body(
        liver,
        lambda: quadratic(liver()),
        # No coarser one: of fewer shells it is another body, held at more of its surface.
        {"linear, finer": lambda: refined(liver())},
        "liver_pignn",
        tests=6,
    ),
    "ventricle": Body(
        lambda: ventricle(15, 30, 3),
        lambda: ventricle(20, 40, 3, order=2),
        {
            "linear, coarser": lambda: ventricle(10, 20, 2),
            "linear, finer": lambda: ventricle(22, 44, 4),
            "quadratic, coarser": lambda: ventricle(8, 16, 1, order=2),
            "quadratic": lambda: ventricle(15, 30, 3, order=2),
        },
        "left_ventricle_pignn",
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
