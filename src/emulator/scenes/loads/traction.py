"""Dead traction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation, facet_rule
from emulator.geometry.facets import nodal_areas
from emulator.scenes.fibre_angles import Fibres
from emulator.scenes.loads.load import Load, nodal_sums
from emulator.scenes.local_terms import LocalForce, Values


@dataclass(frozen=True)
class Traction(Load):
    r"""Dead traction, potential :math:`-\int t \cdot u\, dA` over the reference surface.

    Parameters
    ----------
    facet_set : the surface it acts on.
    traction : force per reference area in kPa, three components; it keeps its direction.
    """

    kind: ClassVar[str] = "traction"

    facet_set: str
    traction: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.traction) != 3 or not np.isfinite(self.traction).all():
            raise InputError(
                f"traction on '{self.facet_set}' is {self.traction}; give 3 finite numbers in kPa"
            )

    @property
    def facet_sets(self) -> tuple[str, ...]:
        """The facet set it acts on."""
        return (self.facet_set,)

    def nodal_force(self, grid: Discretisation) -> np.ndarray:
        """Consistent nodal forces, (n, 3) in mN."""
        mesh = grid.mesh
        facets = mesh.facet_set(self.facet_set)
        rule = facet_rule(mesh.order, 4)
        area = nodal_areas(mesh.nodes[facets], rule)
        return nodal_sums(mesh, facets, area)[:, None] * np.asarray(self.traction, dtype=float)

    def on_loaded(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalForce:
        """The force by the surface at rest, ``x + w``."""
        del fibres
        mesh = grid.mesh
        facets, rule = mesh.facet_set(self.facet_set), facet_rule(mesh.order, 4)

        def force(w: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            del values
            return nodal_areas(corners + w, rule)[:, None] * np.asarray(self.traction, dtype=float)

        return LocalForce(facets, mesh.nodes[facets], force)
