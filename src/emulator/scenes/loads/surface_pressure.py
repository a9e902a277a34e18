"""What all pressures on a surface share; positive pushes into the tissue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.identity import plain_fields
from emulator.scenes.loads.load import Load
from emulator.scenes.local_terms import Values

KPA_PER_MMHG = 0.133322


@dataclass(frozen=True)
class SurfacePressure(Load):
    """A pressure on a facet set; subclasses define its virtual work.

    Parameters
    ----------
    facet_set : the surface it acts on.
    pressure : kPa, or ``None`` to make it a parameter of the scene.
    parameter : name of that parameter; give each of several pressures its own.
    """

    facet_set: str
    pressure: float | None = None
    parameter: str = "pressure"

    def __post_init__(self) -> None:
        if self.pressure is not None and not np.isfinite(self.pressure):
            raise InputError(f"pressure on '{self.facet_set}' is {self.pressure} kPa")

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """The facet set it acts on."""
        return (self.facet_set,)

    @property
    def pressed(self) -> str:
        """The facet set it acts on."""
        return self.facet_set

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The pressure, if it is a parameter; suction is negative."""
        if self.pressure is not None:
            return ()
        return (Quantity(self.parameter, "kPa", -np.inf, hint=f"1 mmHg = {KPA_PER_MMHG} kPa"),)

    def to_json(self) -> list[Any]:
        """Every field; a parameter's name says nothing where the pressure is known."""
        return plain_fields(self, () if self.pressure is None else ("parameter",))

    def value(self, values: Values) -> jax.Array | float:
        """The pressure in kPa, taken from the scene's resolved parameters if it is one."""
        return values[self.parameter] if self.pressure is None else self.pressure
