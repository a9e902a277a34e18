"""The bodies that are unloaded, and theta."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import emulator as em
from emulator.fem import uniform
from emulator.released.scenes import published_scene
from emulator.scenes import Parameter, Scene
from emulator.scenes.finer import finer
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure

PRESSURE = Parameter("pressure", "kPa", 4.0 * KPA_PER_MMHG, 15.0 * KPA_PER_MMHG)


def built_in(order: int, cells: tuple[int, ...] = ()) -> Scene:
    """The built-in left ventricle with elements of ``order``, 4 to 15 mmHg.

    cells : rings, around, layers; by default its own.
    """
    return _wide(em.scenes.left_ventricle(*cells, order=order))


def released(order: int, root: Path) -> Scene:
    """The paper's ventricle under the exact pressure of its cavity, 4 to 15 mmHg.

    Of order 2: its tetrahedra made quadratic.
    """
    scene = published_scene("LeftVentricle", root)
    parameters = (*scene.parameters, PRESSURE)
    loads = (CavityPressure("endocardium"),)
    scene = replace(scene, parameters=parameters, loads=loads, origin={})
    return scene if order == 1 else finer(scene).scene


def _wide(scene: Scene) -> Scene:
    material = tuple(p for p in scene.parameters if p.name != "pressure")
    return replace(scene, parameters=(*material, PRESSURE), origin={})


def imaged(scene: Scene, pressure: float) -> Scene:
    """``scene``, whose mesh is that of an image taken under ``pressure`` kPa."""
    constants = {**scene.constants, "imaged": pressure}
    return replace(scene, loaded_by={"pressure": "imaged"}, constants=constants, origin={})


def some_theta(scene: Scene, count: int, seed: int) -> jax.Array:
    """Theta (count, p), uniform over the box."""
    return uniform(scene, count, jax.random.key(seed))


def farthest(field: jax.Array) -> float:
    """Largest distance in mm of a field (n, 3)."""
    return float(np.linalg.norm(np.asarray(field), axis=-1).max())


def direction(scene: Scene, rng: np.random.Generator) -> jax.Array:
    """A random direction (p,) in theta, on the scale of the centre of the box."""
    return jnp.asarray(rng.normal(size=len(scene.parameters))) * scene.centre
