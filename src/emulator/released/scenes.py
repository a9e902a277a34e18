"""Scenes on the released meshes of Dalton et al. (2023), in mm and kPa."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, look_up
from emulator.mechanics.laws import find_law
from emulator.released.files import (
    PRESSURE_SURFACE,
    PublishedTests,
    read_geometry,
    read_tests,
    units,
)
from emulator.scenes.loads import Gravity, Load, PublishedPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support

_GRAVITY = Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=9.80)


class _Model(NamedTuple):
    """Law, parameters (in the order of the stored theta), loads and constants of a model."""

    law: str
    parameters: tuple[Parameter, ...]
    loads: tuple[Load, ...] = ()
    constants: Mapping[str, float] = MappingProxyType({})


_BEAM = _Model(
    "neo_hookean",
    (Parameter("mu", "kPa", 50.0, 100.0, "log"), Parameter("lam", "kPa", 50.0, 100.0, "log")),
    (_GRAVITY,),
)
_MODELS = {
    "OnceClampedBeam": _BEAM,
    "TwiceClampedBeam": _BEAM,
    "TwistingBeam": _Model(
        "neo_hookean_E_nu",
        (Parameter("E", "kPa", 1.0, 25.0, "log"), Parameter("nu", "", 0.1, 0.4, "log")),
    ),
    "Liver": _Model(
        "neo_hookean",
        (Parameter("lam", "kPa", 3.5, 10.0, "log"), Parameter("mu", "kPa", 3.5, 10.0, "log")),
        (_GRAVITY,),
    ),
    "LeftVentricle": _Model(
        "holzapfel_ogden_released",
        (
            Parameter("a", "kPa", 0.1, 0.26, "log"),
            Parameter("b", "", 1.0, 4.2, "log"),
            Parameter("a_f", "kPa", 1.5, 5.18, "log"),
            Parameter("b_f", "", 1.0, 4.46, "log"),
        ),
        (PublishedPressure(PRESSURE_SURFACE, pressure=1.06658),),  # 8 mmHg
        MappingProxyType({"kappa": 25.0}),
    ),
}
MODELS = tuple(_MODELS)


def published_scene(model: str, root: str | Path) -> Scene:
    """The scene of a released model, read from ``root``."""
    found = _find(model)
    geometry = read_geometry(root, model)
    return Scene(
        name=f"published:{model}",
        mesh=geometry.mesh,
        law=find_law(found.law),
        parameters=found.parameters,
        loads=found.loads,
        supports=(Support("held", geometry.displacement),),
        constants=found.constants,
        fibres=geometry.fibres,
        origin={"scene": f"published:{model}", "root": str(Path(root).resolve())},
    )


def _find(model: str) -> _Model:
    return look_up(_MODELS, model, "published model")


def published_tests(model: str, root: str | Path) -> tuple[jax.Array, PublishedTests]:
    """Theta (c, p) in the scene's units, and the stored solutions at these theta."""
    parameters = _find(model).parameters
    tests = read_tests(root, model)
    if tests.theta.shape[1] != len(parameters):
        raise InputError(f"published model '{model}': theta has shape {tests.theta.shape}")
    return jnp.asarray(tests.theta) * theta_units(model), tests


def theta_units(model: str) -> np.ndarray:
    """Factors (p,) from the stored theta to the scene's."""
    stress = units(model).stress
    return np.array([stress if p.unit == "kPa" else 1.0 for p in _find(model).parameters])
