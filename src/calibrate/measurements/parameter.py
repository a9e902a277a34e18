"""A parameter that was measured itself: a pressure by catheter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import jax
import numpy as np

from calibrate.measurements.scalar import Scalar
from calibrate.noise.protocol import Noise
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

    kind: ClassVar[str] = "parameter"
    usage: ClassVar[str] = "parameter:NAME"
    quantity: ClassVar[str] = "parameter"

    def __post_init__(self) -> None:
        if self.parameter not in self.scene.parameter_names:
            raise InputError(
                f"parameter '{self.parameter}' cannot be measured in scene '{self.scene.name}'; "
                f"it has {', '.join(self.scene.parameter_names)}"
            )

    @property
    def unit(self) -> str:
        """The parameter's unit, ``1`` where it has none."""
        return self.scene.quantities[self.parameter].unit or "1"

    @property
    def other_units(self) -> Mapping[str, float]:
        """Of a pressure or a modulus: mmHg and multiples of Pa."""
        return _OTHER_UNITS.get(self.unit, {})

    @property
    def default_noise(self) -> Noise:
        """None: how well a parameter is measured depends on it."""
        raise InputError(
            f"{self.names[0]} has no usual noise; give --noise {self.names[0]}=SD, in {self.unit}"
        )

    @property
    def nodes(self) -> np.ndarray:
        """The first node; no displacement is needed, but forward maps predict one or more."""
        return np.zeros(1, dtype=int)

    @property
    def names(self) -> tuple[str, ...]:
        """``parameter:pressure`` and the like."""
        return (f"{self.kind}:{self.parameter}",)

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """The entry (...) of ``theta``."""
        return theta[..., self.scene.parameter_names.index(self.parameter)]

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` unless ``values`` is one admissible number, or missing."""
        self._check_number(name, values)
        if np.isnan(values):
            return
        if fault := self.scene.quantities[self.parameter].value_fault(float(values)):
            raise InputError(f"data: {fault}")

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``parameter:pressure``."""
        kind, _, name = word.partition(":")
        return (word, cls(scene, name)) if kind == cls.kind else None
