r"""Tension of a sheet of tissue in its reference state, as in living skin.

A tension :math:`T` in every direction of the plane across the normal n adds the second
Piola-Kirchhoff stress :math:`S = T\,(I - n \otimes n)` to that of the law. Its energy is

.. math:: \Psi = \int_\Omega \frac{T}{2} \left[(I_1 - 3) - (|F n|^2 - 1)\right] dX .

It is the same everywhere. So a sheet that is held along its edge and pressed by nothing is in
equilibrium as it lies, however its stiffness differs from place to place: no shape at rest has to
be found, and displacements are those from where it lies. The moduli of the law are those of the
tissue as it lies, stretched by what nobody saw. A stretch in place of a tension would leave a stiff
region under more stress than its surroundings, and the mesh out of equilibrium.

The energy is that of springs between nodes (:mod:`~emulator.scenes.loads.active_tension`); it is
convex, and tension stiffens the sheet against being sheared or pushed out of its plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws.law import Quantity
from emulator.scenes.loads.active_tension import energy_of_spring, springs
from emulator.scenes.part import Load, LocalTerm, Values
from emulator.scenes.tissue import Fibres

_AXES = "xyz"


@dataclass(frozen=True)
class Prestress(Load):
    """Tension of a sheet as it lies, the same in all directions of its plane.

    Parameters
    ----------
    tension : T in kPa, 0 or more; without it, the tension is a parameter of the scene.
    normal : the axis across the sheet, x, y or z.
    parameter : name of that parameter. It belongs to the body: load states share it.
    """

    kind: ClassVar[str] = "prestress"
    magnitude: ClassVar[Quantity] = Quantity("tension", "kPa", low_admitted=True)
    shared: ClassVar[bool] = True

    tension: float | None = None
    normal: str = "z"
    parameter: str = "prestress"

    def __post_init__(self) -> None:
        if self.tension is not None and not 0.0 <= self.tension < np.inf:
            raise InputError(f"prestress: tension is {self.tension} kPa; it must be 0 or more")
        if self.normal not in tuple(_AXES):
            raise InputError(f"prestress: normal is '{self.normal}'; give x, y or z")

    @property
    def simpler(self) -> tuple[str, None]:
        """A sheet without tension."""
        return "prestress", None

    @property
    @override
    def energy_density(self) -> Callable[[jax.Array, Values], jax.Array]:
        """Half the tension times the squares of the gradient's columns in the plane."""

        def density(H: jax.Array, values: Values) -> jax.Array:
            within = jnp.sum(H**2, axis=-2) @ np.diag(self._unit_stress)
            return 0.5 * self.value(values) * within

        return density

    @override
    def first_piola(
        self, F: jax.Array, mesh: Mesh, fibres: jax.Array | None, values: Values
    ) -> jax.Array:
        return self.value(values) * (F @ self._unit_stress)

    @override
    def terms(self, grid: Discretisation, fibres: Fibres | None = None) -> tuple[LocalTerm, ...]:
        """Return springs between nodes."""

        def energy(u: jax.Array, spring: tuple[jax.Array, jax.Array], values: Values) -> jax.Array:
            return self.value(values) * energy_of_spring(u, spring)

        pairs, stiffness = springs(
            grid.connectivity, grid.gradients, grid.weights, self._unit_stress
        )
        X = grid.mesh.nodes
        ends = (stiffness, X[pairs[:, 1]] - X[pairs[:, 0]])
        return (LocalTerm(pairs, ends, energy, convex=True),)

    @property
    def _unit_stress(self) -> np.ndarray:
        """The stress (3, 3) at a tension of 1."""
        return np.diag([float(axis != self.normal) for axis in _AXES])
