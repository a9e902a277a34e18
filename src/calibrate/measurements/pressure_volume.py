"""The volume of a cavity over the range of the pressure in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.volume import CavityVolume
from emulator.scenes.cavities import inflated_cavity
from emulator.scenes.loads import KPA_PER_MMHG
from emulator.scenes.parameter_space import Parameter
from emulator.surrogates.protocol import ForwardMap

_PRESSURES = 12


def in_mmhg(kpa: float) -> str:
    """A pressure of so many kPa in both units."""
    return f"{kpa:.3g} kPa ({kpa / KPA_PER_MMHG:.3g} mmHg)"


class PressureVolume(NamedTuple):
    """A pressure-volume curve as a function of theta.

    volume : of the cavity. parameter : the pressure in it. rest : mL, of the unloaded body.
    pressures : (k,), in the parameter's unit.
    volumes : theta (p,), of any pressure, -> (k,) mL.
    """

    volume: CavityVolume
    parameter: Parameter
    rest: float
    pressures: np.ndarray
    volumes: Callable[[jax.Array], jax.Array]


def pressure_volume(forward: ForwardMap) -> PressureVolume | None:
    """Of the first cavity whose pressure is a parameter; ``None`` without any."""
    scene = forward.scene
    found = inflated_cavity(scene)
    if found is None:
        return None
    volume, column = CavityVolume(scene, found[0]), scene.parameter_names.index(found[1])
    parameter = scene.parameters[column]
    pressures = np.linspace(parameter.low, parameter.high, _PRESSURES)
    wall = forward.at(volume.nodes)

    def volumes(theta: jax.Array) -> jax.Array:
        def one(pressure: jax.Array) -> jax.Array:
            return volume.cavity(wall(theta.at[column].set(pressure)))

        return jax.lax.map(one, jnp.asarray(pressures))

    rest = float(volume.cavity.rest)
    return PressureVolume(volume, parameter, rest, pressures, volumes)
