"""Twenty bodies that the shipped network of ventricles refuses, each for what is odd about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.geometry.fibres import unit
from emulator.geometry.mesh import Mesh
from emulator.scenes.loads import ActiveTension, FollowerPressure, Gravity
from emulator.scenes.scene import Scene
from emulator.scenes.supports import ElasticSupport
from emulator.surrogates import load


def usual() -> Scene:
    """A ventricle that the network takes."""
    return em.scenes.left_ventricle(7, 20, 2)


def moved(place: Callable[[np.ndarray], np.ndarray], fibres: object = None) -> Scene:
    """The usual one with its nodes elsewhere, and other fibres (m, q, 3) if they are given."""
    scene = usual()
    mesh = scene.mesh
    other = Mesh(place(mesh.nodes), mesh.elements, mesh.node_sets, mesh.facet_sets)
    return replace(scene, mesh=other, fibres=scene.fibres if fibres is None else fibres, origin={})


def ranged(name: str, **changed: float) -> Scene:
    """The usual one with another range of a parameter."""
    scene = usual()
    box = tuple(replace(p, **changed) if p.name == name else p for p in scene.parameters)
    return replace(scene, parameters=box, origin={})


def open_cavity() -> Scene:
    """The usual one under a pressure that needs no closed cavity."""
    return replace(usual(), loads=(FollowerPressure("endocardium"),), origin={})


def held_all_over() -> Scene:
    """The usual one held at its base and outside."""
    scene = usual()
    mesh = scene.mesh
    sets = {**mesh.node_sets, "outside": np.unique(mesh.facet_set("epicardium"))}
    other = Mesh(mesh.nodes, mesh.elements, sets, mesh.facet_sets)
    supports = (em.Support("base"), em.Support("outside"))
    return replace(scene, mesh=other, supports=supports, origin={})


def straight() -> np.ndarray:
    """Fibres along the axis everywhere."""
    fibres = np.zeros_like(usual().fibres)
    fibres[..., 2] = 1.0
    return fibres


def mirrored() -> Scene:
    """A helix of the other hand."""
    scene = usual()
    centroids = scene.mesh.nodes[scene.mesh.elements].mean(axis=1)
    around = unit(np.cross([0.0, 0.0, 1.0], centroids))[:, None]
    across = np.sum(scene.fibres * around, axis=-1, keepdims=True) * around
    return replace(scene, fibres=unit(scene.fibres - 2.0 * across), fibre_rule=None, origin={})


def also(*loads: object) -> Scene:
    """The usual one under more loads."""
    scene = usual()
    return replace(scene, loads=(*scene.loads, *loads), origin={})


def on_springs() -> Scene:
    """The usual one with springs around it."""
    scene = usual()
    springs = ElasticSupport("epicardium", 0.1)
    return replace(scene, supports=(*scene.supports, springs), origin={})


ODD = {
    "metres": (lambda: moved(lambda x: 1e-3 * x), "its size is 0.0.* are its coordinates in mm"),
    "centimetres": (lambda: moved(lambda x: 0.1 * x), "its size is .* are its coordinates in mm"),
    "a giant's": (lambda: moved(lambda x: 4.0 * x), "its size is .* are its coordinates in mm"),
    "a pancake": (lambda: moved(lambda x: x * [1.0, 1.0, 0.25]), "unlike the ventricles"),
    "a sausage": (lambda: moved(lambda x: x * [1.0, 1.0, 3.0]), "unlike the ventricles"),
    "a slit": (lambda: moved(lambda x: x * [0.15, 1.0, 1.0]), "unlike the ventricles"),
    "straight fibres": (lambda: moved(lambda x: x, straight()), "unlike .* helix"),
    "a helix of the other hand": (mirrored, "unlike .* helix"),
    "held all over": (held_all_over, "its surface is all cavity and base"),
    "under an open cavity's pressure": (open_cavity, "loads: "),
    "linear elements": (lambda: em.scenes.left_ventricle(7, 20, 2, order=1), "order of elements"),
    "stiffer in volume": (lambda: em.scenes.left_ventricle(7, 20, 2, kappa=250.0), "constants"),
    "softer than any": (lambda: ranged("a", low=0.01), "a ranges from 0.01"),
    "a high pressure": (lambda: ranged("pressure", high=4.0), "pressure ranges from .* to 4 kPa"),
    "contracting": (lambda: also(ActiveTension(5.0)), "loads: "),
    "heavy": (lambda: also(Gravity(1.06)), "loads: "),
    "on springs": (on_springs, "springs: "),
    "without fibres": (
        lambda: em.scenes.left_ventricle_neo_hookean(4, 10, 1),
        "its theta is lam, mu, pressure",
    ),
    "two cavities": (lambda: em.scenes.biventricle(6, 12, (1, 1)), "constants: |unlike|cavities"),
    "a beam": (lambda: em.scenes.once_clamped_beam((4, 2, 2)), "its theta is lam, mu"),
}


@pytest.mark.parametrize("name", ODD)
def test_it_is_refused(name: str) -> None:
    make, words = ODD[name]
    scene = make()
    with pytest.raises(InputError, match=words) as error:
        load("ventricle_family", scene)
    assert "\n" not in str(error.value)


def test_the_usual_one_is_not() -> None:
    scene = usual()
    u = load("ventricle_family", scene).cache()(scene.centre)
    assert 1.0 < np.linalg.norm(u, axis=1).mean() < 15.0
