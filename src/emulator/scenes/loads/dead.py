r"""External loads: dead ones here, those that follow the deformation in their own files.

A dead load is a nodal force, summed once when the scene is discretised.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from emulator.errors import InputError
from emulator.geometry.discretisation import facet_rule
from emulator.geometry.facets import nodal_areas
from emulator.mechanics.quantity import Quantity
from emulator.scenes.loads.follower import FollowerPressure
from emulator.scenes.loads.pressure import CavityPressure, PublishedPressure

if TYPE_CHECKING:
    from emulator.scenes.scene import Scene

# (1 g/cm3)(1 m/s2) = 1e-6 kg/mm3 m/s2 = 1e-6 N/mm3 = 1e-3 mN/mm3, and 1 mN/mm2 = 1 kPa.
_KPA_PER_MM = 1.0e-3


@dataclass(frozen=True)
class Gravity:
    r"""Dead weight, potential :math:`-\int_\Omega b \cdot u\, dX` with :math:`b = \rho g d`.

    Parameters
    ----------
    density : mass density rho in g/cm3.
    direction : three components, made unit length; (0, 0, -1) is down.
    acceleration : g in m/s2. The published beams use 9.80.
    """

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

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What this load takes from theta or the constants: nothing."""
        return ()

    def describe(self) -> list[object]:
        """What tells this load from another, however it was written."""
        return ["gravity", *(float(x) + 0.0 for x in np.round(self.body_force, 12))]

    @property
    def body_force(self) -> np.ndarray:
        """Force per reference volume, kPa/mm, shape (3,)."""
        direction = np.asarray(self.direction, dtype=float)
        weight = self.density * self.acceleration * _KPA_PER_MM
        return weight * direction / np.linalg.norm(direction)

    def nodal_force(self, scene: Scene) -> np.ndarray:
        """Consistent nodal forces, (n, 3) in mN."""
        grid = scene.discretisation
        volume = np.einsum("mq,qa->ma", grid.weights, grid.values)
        return _spread(scene, grid.connectivity, volume)[:, None] * self.body_force


@dataclass(frozen=True)
class Traction:
    r"""Dead traction, potential :math:`-\int t \cdot u\, dA` over the reference surface.

    Parameters
    ----------
    facet_set : where it acts.
    traction : force per reference area in kPa, three components; it keeps its direction.
    """

    facet_set: str
    traction: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.traction) != 3 or not np.isfinite(self.traction).all():
            raise InputError(
                f"traction on '{self.facet_set}' is {self.traction}; give 3 finite numbers in kPa"
            )

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What this load takes from theta or the constants: nothing."""
        return ()

    def describe(self) -> list[object]:
        """What tells this load from another."""
        return ["traction", self.facet_set, *(float(x) + 0.0 for x in self.traction)]

    def nodal_force(self, scene: Scene) -> np.ndarray:
        """Consistent nodal forces, (n, 3) in mN."""
        facets = scene.mesh.facet_set(self.facet_set)
        rule = facet_rule(scene.mesh.order, 4)
        area = nodal_areas(scene.mesh.nodes[facets], rule)
        return _spread(scene, facets, area)[:, None] * np.asarray(self.traction, dtype=float)


def _spread(scene: Scene, nodes: np.ndarray, amounts: np.ndarray) -> np.ndarray:
    """Sum of ``amounts`` (k, a) at each of their ``nodes`` (k, a), shape (n,)."""
    return np.bincount(nodes.ravel(), amounts.ravel(), minlength=len(scene.mesh.nodes))


DeadLoad = Gravity | Traction
Load = DeadLoad | CavityPressure | PublishedPressure | FollowerPressure
