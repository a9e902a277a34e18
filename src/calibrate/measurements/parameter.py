"""A parameter that was measured itself: a pressure by catheter."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from calibrate.measurements.observation import Scalar
from emulator.core.errors import InputError
from emulator.scenes.loads import KPA_PER_MMHG
from emulator.scenes.scene import Scene

_OTHER_UNITS = {"kPa": {"mmHg": KPA_PER_MMHG, "Pa": 1e-3, "MPa": 1e3}}


@dataclass(frozen=True, eq=False)
class MeasuredParameter(Scalar):
    """An entry of theta, one number in the parameter's unit.

    Unlike a known parameter it has noise, and unlike a prior it is data: predicted and checked.

    Raises
    ------
    InputError
        The scene has no such parameter.
    """

    scene: Scene
    parameter: str

    kind = "parameter"
    usage = "parameter:NAME"
    quantity = "parameter"
    arguments = ("parameter",)
    positive = False

    def __post_init__(self) -> None:
        if self.parameter not in self.scene.parameter_names:
            raise InputError(
                f"parameter '{self.parameter}' cannot be measured in scene '{self.scene.name}'; "
                f"it has {', '.join(self.scene.parameter_names)}"
            )
        unit = self.scene.quantities[self.parameter].unit or "1"
        # No displacement is needed, but forward maps predict one node or more.
        self._derive(unit=unit, other_units=_OTHER_UNITS.get(unit, {}), nodes=np.zeros(1, int))

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the entry (...) of ``theta``."""
        return theta[..., self.scene.parameter_names.index(self.parameter)]

    def check_values(self, name: str, values: np.ndarray) -> None:
        """Refuse a number that the parameter cannot have."""
        super().check_values(name, values)
        fault = self.scene.quantities[self.parameter].value_fault(float(values))
        if fault and not np.isnan(values):
            raise InputError(f"data: {fault}")
