"""Scenes that have every effect: a ventricle, two ventricles, and a sheet that is inflated."""

from dataclasses import replace

import numpy as np

import emulator as em
from calibrate.measurements import (
    CavityVolume,
    Observation,
    Observations,
    landmarks,
    spread_nodes,
)
from emulator.geometry.generators.box import box
from emulator.geometry.refinement import to_linear, to_quadratic
from emulator.mechanics.laws import find_law
from emulator.scenes import Scene, Support
from emulator.scenes.built_in.ventricles import MYOCARDIUM, PRESSURE
from emulator.scenes.loads import CavityPressure, Gravity, PublishedPressure
from emulator.scenes.scene import cavity_sets
from emulator.scenes.supports import ElasticSupport

SEED = 7
DISPERSION = 0.08  # of Gasser, Ogden & Holzapfel; 1/3 is isotropy
PERICARDIUM = 0.02  # kPa/mm along the normal; 0.2 is stiff (Pfaller et al. 2019)
TISSUE = 0.005  # kPa/mm in all directions, fat around
DENSITY = 1.06  # g/cm3


def _whole(scene: Scene, outside: str) -> Scene:
    """``scene`` with quadratic elements and all effects; springs act on the facets ``outside``."""
    return replace(
        scene,
        mesh=to_quadratic(scene.mesh),
        dilatation="mean",
        law=find_law("holzapfel_ogden_dispersed"),
        loads=(*scene.loads, Gravity(density=DENSITY, direction=(1.0, 0.0, 0.0))),
        supports=(
            *scene.supports,
            ElasticSupport(outside, TISSUE),
            ElasticSupport(outside, PERICARDIUM, "normal"),
        ),
        constants={**scene.constants, "dispersion": DISPERSION},
        origin={},
    )


def left_ventricle() -> Scene:
    """A ventricle lying on its side."""
    return _whole(em.scenes.left_ventricle(6, 12, 1, order=1), "epicardium")


def biventricle() -> Scene:
    """Two ventricles, each with its pressure."""
    return _whole(em.scenes.biventricle(6, 12, (1, 1), order=1), "epicardium")


def sheet() -> Scene:
    """A bulge test: a sheet of 40 x 40 x 4 mm, clamped all round, inflated from below."""
    mesh = box((40.0, 40.0, 4.0), (6, 6, 2))
    at_rim = np.isclose(np.abs(mesh.nodes[:, :2] - 20.0), 20.0).any(axis=1)
    mesh = replace(mesh, node_sets={**mesh.node_sets, "rim": np.flatnonzero(at_rim)})
    plain = Scene(
        name="inflated sheet",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=(*MYOCARDIUM, PRESSURE),
        loads=(CavityPressure("bottom"),),
        supports=(Support("rim"),),
        constants={"kappa": 25.0},
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
    )
    return _whole(plain, "top")


SCENES = {"left ventricle": left_ventricle, "biventricle": biventricle, "sheet": sheet}


def points(scene: Scene) -> np.ndarray:
    """24 corners of the elements (24, 3) mm, which linear elements have too."""
    linear = replace(scene, mesh=to_linear(scene.mesh), dilatation="pointwise")
    return linear.mesh.nodes[spread_nodes(linear, 24, SEED)]


def observed(scene: Scene, at: np.ndarray) -> Observations:
    """Landmarks ``at`` (d, 3) mm, and the volume of each cavity."""
    parts: dict[str, Observation] = {"displacement": landmarks(scene, at)}
    for name in cavity_sets(scene):
        parts[f"volume of {name}"] = CavityVolume(scene, name)
    return Observations(parts)


def other_choices(scene: Scene) -> dict[str, Scene]:
    """Scenes with another choice in place of one effect, none of them simpler."""
    kappa = scene.constants["kappa"]
    return {
        "kappa, a quarter": replace(scene, constants={**scene.constants, "kappa": 0.25 * kappa}),
        "kappa, four times": replace(scene, constants={**scene.constants, "kappa": 4.0 * kappa}),
    }


def published(scene: Scene) -> Scene:
    """``scene`` on linear elements with the released code's pressure work."""
    loads = tuple(
        PublishedPressure(load.pressed, load.pressure, load.parameter)
        if isinstance(load, CavityPressure) else load
        for load in scene.loads
    )  # fmt: skip
    return replace(scene, mesh=to_linear(scene.mesh), dilatation="pointwise", loads=loads)
