"""Twists."""

from __future__ import annotations

from functools import partial

import numpy as np
from studies.stability.solver.bodies import bar, moduli, moved, twist
from studies.stability.solver.case import CASES, Case, case

import emulator as em


def _twisted(degrees: float, *, started: bool) -> Case:
    mesh = em.generators.box((40.0, 10.0, 10.0), (16, 4, 4))
    centre = np.array([0.0, 5.0, 5.0])
    right = mesh.node_set("right")
    scene = moved(
        bar(mesh=mesh), {"left": (0, 0, 0), "right": twist(mesh.nodes[right], centre, degrees)}
    )
    start = None
    if started:
        turn = degrees * mesh.nodes[:, 0] / 40.0
        start = np.vstack(
            [twist(x[None], centre, d) for x, d in zip(mesh.nodes, turn, strict=True)]
        )
        start = np.where(scene.held, scene.held_displacement, start)
    return Case(scene, moduli(), start)


for _degrees in (90, 180, 270, 360):
    CASES[f"twist_{_degrees}_from_rest"] = (
        "twists",
        partial(_twisted, float(_degrees), started=False),
    )
for _degrees in (180, 360, 540):
    CASES[f"twist_{_degrees}_started_twisted"] = (
        "twists",
        partial(_twisted, float(_degrees), started=True),
    )


@case("twists")
def twist_and_pull() -> Case:
    wrung = _twisted(120.0, started=False)
    support = wrung.scene.supports[1]
    assert isinstance(support, em.Support)
    shift = np.asarray(support.displacement) + np.array([40.0, 0.0, 0.0])
    return Case(moved(wrung.scene, {"left": (0, 0, 0), "right": shift}), moduli())
