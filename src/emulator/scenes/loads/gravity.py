"""Dead weight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from emulator.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.scenes.loads.load import Load, nodal_sums

# (1 g/cm3)(1 m/s2) = 1e-6 kg/mm3 m/s2 = 1e-6 N/mm3 = 1e-3 mN/mm3, and 1 mN/mm2 = 1 kPa.
_KPA_PER_MM = 1.0e-3


@dataclass(frozen=True)
class Gravity(Load):
    r"""Dead weight, potential :math:`-\int_\Omega b \cdot u\, dX` with :math:`b = \rho g d`.

    Parameters
    ----------
    density : mass density rho in g/cm3.
    direction : three components, made unit length; (0, 0, -1) is down.
    acceleration : g in m/s2. The published beams use 9.80.
    """

    kind: ClassVar[str] = "gravity"

    density: float = 1.0
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    acceleration: float = 9.81

    def __post_init__(self) -> None:
        if not np.isfinite(self.density) or self.density < 0.0:
            raise InputError(f"gravity: density is {self.density} g/cm3; it must be 0 or more")
        if not np.isfinite(self.acceleration):
            raise InputError(f"gravity: acceleration is {self.acceleration} m/s2")
        if len(self.direction) != 3 or not 0.0 < np.linalg.norm(self.direction) < np.inf:
            raise InputError(f"gravity: direction is {self.direction}; give 3 numbers, not all 0")

    def to_json(self) -> list[Any]:
        """Kind and body force, the product of density, acceleration and direction."""
        return [self.kind, *(float(x) + 0.0 for x in np.round(self.body_force, 12))]

    @property
    def body_force(self) -> np.ndarray:
        """Force per reference volume, kPa/mm, shape (3,)."""
        direction = np.asarray(self.direction, dtype=float)
        weight = self.density * self.acceleration * _KPA_PER_MM
        return weight * direction / np.linalg.norm(direction)

    def nodal_force(self, grid: Discretisation) -> np.ndarray:
        """Consistent nodal forces, (n, 3) in mN."""
        volume = np.einsum("mq,qa->ma", grid.weights, grid.values)
        return nodal_sums(grid.mesh, grid.connectivity, volume)[:, None] * self.body_force
