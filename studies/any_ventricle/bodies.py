"""The ventricles that the study judges by, none of which the network was trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from studies.any_ventricle.shapes import USUAL, Body, bodies

import emulator as em

BOX = em.scenes.left_ventricle(3, 6, 1).parameters
"""The built-in ventricle's: 4 to 10 mmHg."""
HEART = Path(__file__).parents[2].parent / "shared" / "measured" / "human_heart"
FRAMES = {"human, end of diastole": "000", "human, diastasis": "018"}
_MESHES = {"coarser": (6, 18, 2), "finer": (10, 30, 3)}


def test_bodies(count: int) -> dict[str, Callable[[], em.Scene]]:
    """The scenes by name, made when they are called."""
    found: dict[str, Callable[[], em.Scene]] = {}
    for kind, seed, share in (("ellipsoid", 1, 0.0), ("irregular", 2, 1.0)):
        for k, body in enumerate(bodies(count, seed, share)):
            found[f"{kind} {k}"] = partial(body.scene, 2, BOX)
    for k, body in enumerate(bodies(min(count, 4), 3, 1.0)):
        for name, (rings, around, layers) in _MESHES.items():
            other = replace(body, rings=rings, around=around, layers=layers)
            found[f"{name} {k}"] = partial(other.scene, 2, BOX)
    if find_spec("gmsh") and HEART.is_dir():
        found |= {name: partial(human, frame) for name, frame in FRAMES.items()}
    if find_spec("gmsh"):
        irregular = bodies(min(count, 4), 3, 1.0)
        found |= {f"gmsh {k}": partial(meshed_by_gmsh, body) for k, body in enumerate(irregular)}
    return found


def human(frame: str) -> em.Scene:
    """The left ventricle of the measured heart, its surfaces of ``frame`` taken as at rest."""
    names = ("LV_ENDOCARDIAL", "EPICARDIAL", "RV_ENDOCARDIAL")
    inner, outer, right = (HEART / f"{name}_{frame}.obj" for name in names)
    return _scene(
        "human", em.hearts.mesh_wall(inner, outer, right=right, ventricles="left"), (60.0, -60.0)
    )


def meshed_by_gmsh(body: Body) -> em.Scene:
    """The scene of ``body``, its surfaces meshed anew as those of a scanned heart are."""
    mesh = body.scene().mesh
    surfaces = (_surface(mesh, name) for name in ("endocardium", "epicardium"))
    return _scene("gmsh", em.hearts.mesh_wall(*surfaces), body.angles)


def _surface(mesh: em.Mesh, name: str) -> em.hearts.Surface:
    """A surface of a wall, of flat triangles between all its nodes."""
    facets = mesh.facet_set(name)
    if mesh.order == 2:  # corners, then the middles of 01, 12 and 20
        facets = facets[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]].reshape(-1, 3)
    used, triangles = np.unique(facets, return_inverse=True)
    triangles = triangles.reshape(facets.shape)
    inside = name == "endocardium"  # the tissue's normals point into the cavity
    return em.hearts.Surface(name, mesh.nodes[used], triangles[:, ::-1] if inside else triangles)


def _scene(name: str, wall: Any, angles: tuple[float, float]) -> em.Scene:
    axis = tuple(np.asarray(wall.axis).tolist())
    rule = em.scenes.Helix(angles, axis=axis)
    return replace(
        USUAL,
        name=name,
        mesh=wall.mesh,
        parameters=BOX,
        fibres=rule.directions(wall.mesh)[0],
        fibre_rule=rule,
        origin={},
    )
