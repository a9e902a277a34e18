r"""Pressure that keeps the direction and the area it has on the body at rest.

.. math:: \Pi_p = p \int u \cdot N \, dA

over the reference surface with the normal N pointing out of the tissue. It is what a pressure does
to first order in the displacement, and needs no facet while solving.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np

from emulator.geometry.discretisation import Discretisation, FacetRule, facet_rule
from emulator.geometry.facets import nodal_area_vectors
from emulator.scenes.fibre_angles import Fibres
from emulator.scenes.loads.load import nodal_sums
from emulator.scenes.loads.surface_pressure import SurfacePressure
from emulator.scenes.local_terms import LocalForce, Values


@dataclass(frozen=True)
class DeadPressure(SurfacePressure):
    """Pressure on the surface at rest; positive pushes into the tissue."""

    kind: ClassVar[str] = "dead_pressure"

    def nodal_force(self, grid: Discretisation) -> np.ndarray | None:
        """Consistent nodal forces (n, 3) in mN of a pressure that is given."""
        return None if self.pressure is None else self.pressure * self._per_kpa(grid)

    def nodal_force_per_unit(self, grid: Discretisation) -> dict[str, np.ndarray]:
        """Consistent nodal forces (n, 3) in mN for 1 kPa of a pressure that is a parameter."""
        return {} if self.pressure is not None else {self.parameter: self._per_kpa(grid)}

    def on_loaded(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalForce:
        """The force by the surface at rest, ``x + w``."""
        del fibres
        mesh = grid.mesh
        facets, rule = mesh.facet_set(self.facet_set), self._rule(mesh.order)

        def force(w: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return -self.value(values) * nodal_area_vectors(corners + w, rule)

        return LocalForce(facets, mesh.nodes[facets], force)

    def _per_kpa(self, grid: Discretisation) -> np.ndarray:
        mesh = grid.mesh
        facets = mesh.facet_set(self.facet_set)
        forces = -nodal_area_vectors(mesh.nodes[facets], self._rule(mesh.order))
        xp = forces.__array_namespace__()
        return xp.stack([nodal_sums(mesh, facets, forces[..., i]) for i in range(3)], axis=1)

    @staticmethod
    def _rule(order: int) -> FacetRule:
        """For N_a times the area vector: degree 1 on linear facets, 4 on quadratic ones."""
        return facet_rule(order, 1 if order == 1 else 4)


def at_rest(load: SurfacePressure) -> tuple[str, DeadPressure]:
    """The effect that ``load`` follows the surface, and the pressure without it."""
    dead = DeadPressure(load.facet_set, load.pressure, load.parameter)
    return f"pressure that follows '{load.facet_set}'", dead
