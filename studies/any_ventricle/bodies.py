"""The ventricles that the study judges by, none of which the network was trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from studies.any_ventricle.shapes import USUAL, bodies

from emulator.geometry.two_surfaces import mesh_wall
from emulator.scenes.built_in.ventricles import MYOCARDIUM, PRESSURE
from emulator.scenes.fibre_rules import Helix
from emulator.scenes.scene import Scene

BOX = (*MYOCARDIUM, PRESSURE)
"""The built-in ventricle's: 4 to 10 mmHg."""
HEART = Path(__file__).parents[2].parent / "shared" / "measured" / "human_heart"
FRAMES = {"human, end of diastole": "000", "human, diastasis": "018"}
_MESHES = {"coarser": (6, 18, 2), "finer": (10, 30, 3)}


def test_bodies(count: int) -> dict[str, Callable[[], Scene]]:
    """The scenes by name, made when they are called."""
    found: dict[str, Callable[[], Scene]] = {}
    for kind, seed, share in (("ellipsoid", 1, 0.0), ("irregular", 2, 1.0)):
        for k, body in enumerate(bodies(count, seed, share)):
            found[f"{kind} {k}"] = partial(body.scene, 2, BOX)
    for k, body in enumerate(bodies(min(count, 4), 3, 1.0)):
        for name, (rings, around, layers) in _MESHES.items():
            other = replace(body, rings=rings, around=around, layers=layers)
            found[f"{name} {k}"] = partial(other.scene, 2, BOX)
    if HEART.is_dir():
        found |= {name: partial(human, frame) for name, frame in FRAMES.items()}
    return found


def human(frame: str) -> Scene:
    """The left ventricle of the measured heart, its surfaces of ``frame`` taken as at rest."""
    names = ("LV_ENDOCARDIAL", "EPICARDIAL", "RV_ENDOCARDIAL")
    inner, outer, right = (HEART / f"{name}_{frame}.obj" for name in names)
    wall = mesh_wall(inner, outer, right=right)
    axis = tuple(np.asarray(wall.axis).tolist())
    rule = Helix((60.0, -60.0), axis=axis)
    return replace(
        USUAL,
        name="human",
        mesh=wall.mesh,
        parameters=BOX,
        fibres=rule.directions(wall.mesh)[0],
        fibre_rule=rule,
        origin={},
    )
