"""The force of a support: of a plate that shears a cube, of a clamp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import jax
import numpy as np

from calibrate.measurements.scalar import Scalar
from calibrate.noise.protocol import Noise
from emulator.core.errors import InputError
from emulator.fem.reactions import SupportForce
from emulator.scenes.loads.force import MN_PER_N
from emulator.scenes.scene import Scene

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, eq=False)
class Reaction(Scalar):
    """Force of a support on the body along a direction, one number in N.

    Parameters
    ----------
    scene : with a support there.
    support : name of its node set or facet set.
    direction : ``x``, ``y``, ``z``, or three components joined by commas, made unit length.

    Raises
    ------
    InputError
        No support of that name, or one that does not act along the direction.
    """

    scene: Scene
    support: str
    direction: str

    kind: ClassVar[str] = "reaction"
    usage: ClassVar[str] = "reaction:SUPPORT:AXIS"
    quantity: ClassVar[str] = "force"
    unit: ClassVar[str] = "N"
    other_units: ClassVar[Mapping[str, float]] = {"mN": 1e-3, "gf": 9.80665e-3, "kN": 1e3}

    def __post_init__(self) -> None:
        self.force  # noqa: B018 - a support or direction that is none is refused here

    @cached_property
    def force(self) -> SupportForce:
        """The force in mN as a function of the displacement near the support."""
        return SupportForce(self.scene, self.support, _direction(self.direction))

    @property
    def default_noise(self) -> Noise:
        """None: how well a force is measured depends on the cell."""
        raise InputError(
            f"{self.names[0]} has no usual noise; give --noise {self.names[0]}=SD, in N"
        )

    @property
    def nodes(self) -> np.ndarray:
        """Nodes of the elements at the support, (k,)."""
        return self.force.nodes

    @property
    def names(self) -> tuple[str, ...]:
        """``reaction:top:x`` and the like."""
        return (f"{self.kind}:{self.support}:{self.direction}",)

    def __call__(self, displacement: jax.Array, theta: jax.Array) -> jax.Array:
        """Force (...) in N."""
        return self.force(displacement, theta) / MN_PER_N

    def check(self, name: str, values: np.ndarray) -> None:
        """Raise :class:`InputError` unless ``values`` is one finite number, or missing."""
        self._check_number(name, values)

    @classmethod
    def parse(cls, scene: Scene, word: str, seed: int) -> tuple[str, Self] | None:
        """``reaction:top:x`` or ``reaction:top:0.6,0,0.8``."""
        kind, *rest = word.split(":")
        if kind != cls.kind:
            return None
        if len(rest) != 2 or not all(rest):
            raise InputError(f"observe '{word}': give {cls.usage}, such as reaction:top:x")
        return word, cls(scene, *rest)


def _direction(text: str) -> tuple[float, float, float]:
    if text in _AXES:
        return _AXES[text]
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(
            f"direction '{text}' of a reaction; give x, y, z or three numbers like 0.6,0,0.8"
        ) from None
    return x, y, z
