r"""The pressure work of the released code, for reproducing it; not a follower pressure.

.. math:: \Pi_p = p \int u \cdot \text{cof}(F) N \, dA

differentiated through :math:`\text{cof}(F)` too. On the released ventricle it acts like a pressure
1.39 times larger.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.mesh import Mesh
from emulator.mechanics.kinematics import cofactor
from emulator.scenes.fibre_angles import Fibres
from emulator.scenes.loads.surface_pressure import SurfacePressure
from emulator.scenes.local_terms import LocalTerm, Values


@dataclass(frozen=True)
class PublishedPressure(SurfacePressure):
    """The released pressure work; ``F`` of each facet is that of the element behind it."""

    kind: ClassVar[str] = "published_pressure"

    def check(self, mesh: Mesh, held: np.ndarray, displacement: np.ndarray) -> None:
        """Refuse quadratic tetrahedra, on which the released work is not defined."""
        del held, displacement
        if mesh.order != 1:
            raise InputError(
                f"pressure on '{self.facet_set}': the published work is defined on linear "
                "tetrahedra; use CavityPressure on quadratic ones"
            )

    def term(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalTerm:
        """The released work, facet by facet."""
        del fibres
        mesh = grid.mesh
        facets = mesh.facet_set(self.facet_set)
        behind = mesh.elements_behind(facets)
        corner = mesh.nodes[facets]
        area = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        nodes = mesh.elements[behind]
        on_facet = (nodes[:, :, None] == facets[:, None, :]).any(axis=2)
        data = (area, on_facet / 3.0, grid.gradients[behind, 0])

        def energy(u: jax.Array, data: Any, values: Values) -> jax.Array:
            area, mean, gradients = data
            F = jnp.eye(3, dtype=u.dtype) + u.T @ gradients
            return self.value(values) * jnp.vdot(mean @ u, cofactor(F) @ area)

        return LocalTerm(nodes, data, energy)
