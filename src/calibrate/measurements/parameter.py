"""A parameter that was measured itself: a pressure by catheter."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from calibrate.measurements.observation import Scalar, derive
from emulator.core.errors import InputError
from emulator.scenes.scene import Scene


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
        derive(self, unit=unit, nodes=np.zeros(1, int))

    def evaluate(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Return the entry (...) of ``theta``."""
        return theta[..., self.scene.parameter_names.index(self.parameter)]

    def fault(self, name: str, values: np.ndarray) -> str | None:
        """Return a sentence on a number that the parameter cannot have."""
        if np.isnan(values):
            return None
        return self.scene.quantities[self.parameter].value_fault(float(values))
