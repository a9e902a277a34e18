"""The body that codes are compared on: the released ventricle, or a small plate."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import emulator as em

PRESSURE = 8.0 * em.loads.KPA_PER_MMHG


class Problem(NamedTuple):
    """A pressurised body: its scene at the fixed pressure, and the facets the pressure acts on."""

    name: str
    scene: em.Scene
    facet_set: str


def ventricle(root: Path) -> Problem:
    """The released left ventricle, with the exact cavity pressure in place of the released one."""
    scene = em.released.published_scene("LeftVentricle", root)
    load = em.loads.CavityPressure("endocardium", PRESSURE)
    return Problem("LeftVentricle", dataclasses.replace(scene, loads=(load,)), "endocardium")


def plate() -> Problem:
    """A small plate held at its sides, pressed from below: the same law, no released data."""
    mesh = em.generators.box((10.0, 10.0, 2.0), (4, 4, 2))
    scene = em.Scene(
        name="pressed_plate",
        mesh=mesh,
        law=em.find_law("holzapfel_ogden_released"),
        parameters=(
            em.Parameter("a", "kPa", 0.1, 0.26, "log"),
            em.Parameter("b", "", 1.0, 4.2, "log"),
            em.Parameter("a_f", "kPa", 1.5, 5.18, "log"),
            em.Parameter("b_f", "", 1.0, 4.46, "log"),
        ),
        loads=(em.loads.CavityPressure("bottom", PRESSURE),),
        supports=tuple(em.Support(side) for side in ("left", "right", "front", "back")),
        constants={"kappa": 25.0},
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
    )
    return Problem("plate", scene, "bottom")


def with_free_pressure(problem: Problem) -> em.Scene:
    """The scene with the pressure as its last parameter, 4 to 10 mmHg."""
    pressure = em.Parameter(
        "pressure", "kPa", 4.0 * em.loads.KPA_PER_MMHG, 10.0 * em.loads.KPA_PER_MMHG
    )
    return dataclasses.replace(
        problem.scene,
        loads=(em.loads.CavityPressure(problem.facet_set),),
        parameters=(*problem.scene.parameters, pressure),
    )


def arrays(problem: Problem) -> dict[str, Any]:
    """The problem as plain arrays, for the other codes."""
    scene = problem.scene
    return {
        "nodes": scene.mesh.nodes,
        "elements": scene.mesh.elements,
        "fibres": scene.fibres,
        "facets": scene.mesh.facet_set(problem.facet_set),
        "held": np.flatnonzero(scene.held.all(axis=1)),
        "pressure": PRESSURE,
        "kappa": scene.constants["kappa"],
    }
