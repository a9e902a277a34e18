"""Scenes on the released meshes of Dalton et al. (2023), in mm and kPa."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp

from emulator.errors import InputError
from emulator.geometry.published import PublishedTests, read_mesh, read_tests, units
from emulator.mechanics.laws import find_law
from emulator.mechanics.loads import Gravity
from emulator.scenes.parameters import Parameter
from emulator.scenes.scene import Scene, Support

_GRAVITY = Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=9.80)
_MODELS = {
    # law, parameters in the order of the stored theta, loads
    "OnceClampedBeam": (
        "neo_hookean",
        (Parameter("mu", "kPa", 50.0, 100.0, "log"), Parameter("lam", "kPa", 50.0, 100.0, "log")),
        (_GRAVITY,),
    ),
    "TwistingBeam": (
        "neo_hookean_E_nu",
        (Parameter("E", "kPa", 1.0, 25.0, "log"), Parameter("nu", "", 0.1, 0.4, "log")),
        (),
    ),
}
MODELS = tuple(_MODELS)


def published_scene(model: str, root: str | Path) -> Scene:
    """The scene of a released model, read from ``root``."""
    if model not in _MODELS:
        raise InputError(f"published model '{model}' is unknown; known: {', '.join(MODELS)}")
    law, parameters, loads = _MODELS[model]
    mesh, displacement = read_mesh(root, model)
    return Scene(
        name=f"published:{model}",
        mesh=mesh,
        law=find_law(law),
        parameters=parameters,
        loads=loads,
        supports=(Support("held", displacement),),
        recipe={"scene": f"published:{model}", "root": str(Path(root).resolve())},
    )


def published_tests(model: str, root: str | Path) -> tuple[jax.Array, PublishedTests]:
    """Theta (c, p) in the scene's units, and the stored solutions they belong to."""
    if model not in _MODELS:
        raise InputError(f"published model '{model}' is unknown; known: {', '.join(MODELS)}")
    tests = read_tests(root, model)
    _, parameters, _ = _MODELS[model]
    if tests.theta.shape[1] != len(parameters):
        raise InputError(f"published model '{model}': theta has shape {tests.theta.shape}")
    stress = units(model).stress
    scale = jnp.array([stress if parameter.unit == "kPa" else 1.0 for parameter in parameters])
    return jnp.asarray(tests.theta) * scale, tests
