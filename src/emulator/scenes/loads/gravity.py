r"""Dead weight, in one direction or in any.

Potential :math:`-\int_\Omega \rho\, g \cdot u\, dX` with the acceleration :math:`g`. It is linear
in :math:`g`, so a body that is turned between measurements needs one force field a component.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.mechanics.kinematics import determinant
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.part import Load, LocalForce, Values, sums
from emulator.scenes.tissue import Fibres

# (1 g/cm3)(1 m/s2) = 1e-6 kg/mm3 m/s2 = 1e-6 N/mm3 = 1e-3 mN/mm3, and 1 mN/mm2 = 1 kPa.
_KPA_PER_MM = 1.0e-3


@dataclass(frozen=True)
class Weight(Load):
    """Dead weight; subclasses say which forces per volume it has.

    Parameters
    ----------
    density : mass density in g/cm3.
    """

    density: float = 1.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.density) or self.density < 0.0:
            raise InputError(f"{self.kind}: density is {self.density} g/cm3; it must be 0 or more")

    @property
    @abstractmethod
    def body_forces(self) -> Mapping[str | None, np.ndarray]:
        """Forces per volume at rest (3,) in kPa/mm, per unit of the parameter that is the key."""

    @property
    def simpler(self) -> tuple[str, None]:
        """No weight."""
        return "gravity", None

    @override
    def dead_forces(self, grid: Discretisation) -> Mapping[str | None, np.ndarray]:
        volumes = sums(len(grid.mesh.nodes), grid.connectivity, grid.weights @ grid.values)
        return {name: volumes[:, None] * force for name, force in self.body_forces.items()}

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        body_forces = self.body_forces

        def force(w: jax.Array, data: tuple[jax.Array, jax.Array], values: Values) -> jax.Array:
            gradients, weights = data
            f = jnp.einsum("ai,qaj->qij", w, gradients) + jnp.eye(3, dtype=w.dtype)
            volumes = (weights * jax.vmap(determinant)(f)) @ grid.values
            scaled = (b if name is None else values[name] * b for name, b in body_forces.items())
            return volumes[:, None] * sum(scaled)

        return (LocalForce(grid.connectivity, (grid.gradients, grid.weights), force),)


@dataclass(frozen=True)
class Gravity(Weight):
    r"""Dead weight in one direction.

    Its potential is :math:`-\int_\Omega b \cdot u\, dX` with :math:`b = \rho g d`.

    Parameters
    ----------
    density : mass density rho in g/cm3.
    direction : three components, made unit length; (0, 0, -1) is down.
    acceleration : g in m/s2. The published beams use 9.80.
    """

    kind: ClassVar[str] = "gravity"

    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    acceleration: float = 9.81

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.acceleration):
            raise InputError(f"gravity: acceleration is {self.acceleration} m/s2")
        if len(self.direction) != 3 or not 0.0 < np.linalg.norm(self.direction) < np.inf:
            raise InputError(f"gravity: direction is {self.direction}; give 3 numbers, not all 0")

    @override
    def to_json(self) -> list[Any]:
        """Return kind and body force, the product of density, acceleration and direction."""
        return [self.kind, *(float(x) + 0.0 for x in np.round(self.body_force, 12))]

    @property
    def body_force(self) -> np.ndarray:
        """Force per reference volume, kPa/mm, shape (3,)."""
        direction = np.asarray(self.direction, dtype=float)
        weight = self.density * self.acceleration * _KPA_PER_MM
        return weight * direction / np.linalg.norm(direction)

    @property
    @override
    def body_forces(self) -> Mapping[str | None, np.ndarray]:
        return {None: self.body_force}


@dataclass(frozen=True)
class GravityVector(Weight):
    """Dead weight in any direction: the components of the acceleration are parameters, in m/s2.

    Parameters
    ----------
    parameter : the components are this name with _x, _y and _z.
    """

    kind: ClassVar[str] = "gravity_vector"

    parameter: str = "gravity"

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The three components."""
        return tuple(Quantity(f"{self.parameter}_{axis}", "m/s2", -np.inf) for axis in "xyz")

    @property
    @override
    def body_forces(self) -> Mapping[str | None, np.ndarray]:
        weight = self.density * _KPA_PER_MM
        return {q.name: weight * axis for q, axis in zip(self.quantities, np.eye(3), strict=True)}
