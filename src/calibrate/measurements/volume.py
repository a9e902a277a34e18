"""The volume of a cavity, and its curve over the range of the pressure in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements.observation import Scalar, derive
from emulator.core.units import KPA_PER_MMHG
from emulator.geometry.facets import Cavity
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene, find_cavity, inflated_cavity
from emulator.surrogates.protocol import ForwardMap

_PRESSURES = 12  # number of pressures of a curve


@dataclass(frozen=True, eq=False)
class CavityVolume(Scalar):
    """The volume of a cavity, one number in mL.

    scene : the scene, with the cavity in its mesh.
    facet_set : the cavity's wall; needed where the scene has several cavities.
    cavity : the volume as a function of the wall's displacement, derived.

    Raises
    ------
    InputError
        No such set, one that encloses nothing, or several cavities and no name.
    """

    scene: Scene
    facet_set: str | None = None
    cavity: Cavity = field(init=False)

    kind = "volume"
    quantity = "volume"
    unit = "mL"
    usual_sd = 1.0
    arguments = ("facet_set",)
    kind_is_name = True

    def __post_init__(self) -> None:
        cavity = find_cavity(self.scene, self.facet_set)
        derive(self, cavity=cavity, facet_set=cavity.facet_set, nodes=cavity.nodes)

    @classmethod
    def of(cls, scene: Scene, facet_set: str = "") -> Self:
        """Return the observation of the cavity of this wall, or of the only one."""
        return cls(scene, facet_set or None)

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the volume (...) in mL."""
        return self.cavity(displacement)

    def through(self, forward: ForwardMap) -> Callable[[jax.Array], jax.Array] | None:
        """Return the volume () in mL from the coefficients of a map's modes, where that is less."""
        from_modes = getattr(forward, "volume", None)
        return None if from_modes is None else from_modes(self.cavity)


class PressureVolume(NamedTuple):
    """A pressure-volume curve as a function of theta.

    volume : the volume of the cavity.
    parameter : the pressure in the cavity.
    rest : the volume of the unloaded body, mL.
    pressures : the pressures of the curve, in the parameter's unit, (k,).
    volumes : maps theta (p,), with any pressure, to volumes (k,) in mL.
    """

    volume: CavityVolume
    parameter: Parameter
    rest: float
    pressures: np.ndarray
    volumes: Callable[[jax.Array], jax.Array]


def pressure_volume(forward: ForwardMap) -> PressureVolume | None:
    """Return the curve of the first cavity whose pressure is a parameter; None without any."""
    scene = forward.scene
    if not isinstance(scene, Scene) or (inflated := inflated_cavity(scene)) is None:
        return None
    volume, column = CavityVolume(scene, inflated[0]), scene.parameter_names.index(inflated[1])
    parameter = scene.parameters[column]
    pressures = np.linspace(parameter.low, parameter.high, _PRESSURES)
    wall = forward.at(volume.nodes)

    def volumes(theta: jax.Array) -> jax.Array:
        def one(pressure: jax.Array) -> jax.Array:
            return volume.cavity(wall(theta.at[column].set(pressure)))

        return jax.lax.map(one, jnp.asarray(pressures))

    rest = float(volume.cavity.rest)
    return PressureVolume(volume, parameter, rest, pressures, volumes)


def in_mmhg(kpa: float) -> str:
    """Return a pressure of so many kPa in words, in kPa and mmHg."""
    return f"{kpa:.3g} kPa ({kpa / KPA_PER_MMHG:.3g} mmHg)"
