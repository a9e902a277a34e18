"""The bodies: a scene, its meshes coarser and finer, and one fine enough to be the truth.

A finer mesh is made by the body's generator; for the released bodies by cutting the mesh's own
tetrahedra in eight, so that it is the same polyhedron, held at the same facets. Displacements are
compared at the same material points.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from studies.accuracy_vs_time.refinement import quadratic, refined

import emulator as em

SERIES, NETWORK = "series as shipped", "graph network"


@dataclass(frozen=True)
class Body:
    """One body.

    scene : makes what emulators are of. meshes : other discretisations by name. truth : the
    finest; none where there is none. shipped : emulators by label, on whatever mesh. coarse : the
    scene whose emulator is carried to a finer mesh, if any. model : whose released network is of
    this body; empty for none. tests : theta. tolerances : looser ones of FEM. orders : of series.
    runs, reduced : FEM runs of series with discrepancy and of POD + GP. calls : of each timing of
    FEM. fenics : whether FEniCSx solves it, too.
    """

    scene: Callable[[], em.Scene]
    truth: Callable[[], em.Scene] | None
    meshes: dict[str, Callable[[], em.Scene]]
    shipped: dict[str, str] = field(default_factory=dict)
    coarse: Callable[[], em.Scene] | None = None
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
            "two meshes": self.coarse,
            "released": self.model,
            "meshes": self.meshes,
            "float32": self.shipped or self.model,
            "FEniCSx": self.fenics,
        }
        return bool(asked.get(stage, True))


def of_scene(name: str) -> dict[str, str]:
    """The series and the graph network that are shipped of a scene."""
    return {SERIES: f"{name}_series", NETWORK: name}


def linear(scene: Callable[..., em.Scene], *sizes: Any) -> Callable[[], em.Scene]:
    """``scene`` in linear elements."""
    return lambda: scene(*sizes, order=1)


BODIES = {
    "beam": Body(
        em.scenes.once_clamped_beam,
        lambda: em.scenes.once_clamped_beam((60, 6, 6)),
        {
            "linear": linear(em.scenes.once_clamped_beam),
            "linear, finer": linear(em.scenes.once_clamped_beam, (24, 8, 10)),
            "linear, finest": linear(em.scenes.once_clamped_beam, (36, 12, 15)),
            "coarser": lambda: em.scenes.once_clamped_beam((10, 1, 1)),
            "finer": lambda: em.scenes.once_clamped_beam((40, 4, 4)),
        },
        of_scene("once_clamped_beam"),
        em.scenes.once_clamped_beam,
        fenics=True,
    ),
    "cube": Body(
        em.scenes.twisting_cube,
        lambda: em.scenes.twisting_cube(12),
        {
            "linear": linear(em.scenes.twisting_cube),
            "linear, finer": linear(em.scenes.twisting_cube, 12),
            "coarser": lambda: em.scenes.twisting_cube(2),
            "finer": lambda: em.scenes.twisting_cube(8),
        },
        of_scene("twisting_cube"),
        em.scenes.twisting_cube,
        fenics=True,
    ),
    "liver": Body(
        em.scenes.liver,
        lambda: em.scenes.liver(10),
        # A ligament of five shells, as the quadratic one's.
        {
            "linear": lambda: em.scenes.liver(
                5, order=1, ligament=2.0, clustering=0.5, ligament_shells=5
            )
        },
        of_scene("liver"),
        tests=6,
    ),
    "ventricle": Body(
        em.scenes.left_ventricle,
        lambda: em.scenes.left_ventricle(20, 40, 4),
        {
            "linear": linear(em.scenes.left_ventricle),
            "linear, finer": linear(em.scenes.left_ventricle, 22, 44, 4),
            "coarser": lambda: em.scenes.left_ventricle(8, 16, 1),
            "finer": lambda: em.scenes.left_ventricle(15, 30, 3),
        },
        of_scene("left_ventricle"),
        lambda: em.scenes.left_ventricle(8, 16, 1),
        fenics=True,
    ),
}
_RELEASED: dict[str, tuple[str, Callable[[em.Scene], em.Scene] | None]] = {
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
        lambda: em.released.published_scene(model, published),
        None if finer is None else lambda: finer(em.released.published_scene(model, published)),
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
