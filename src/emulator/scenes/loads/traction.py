"""Dead traction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, override

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation, facet_rule
from emulator.geometry.facets import nodal_areas
from emulator.scenes.part import Load, LocalForce, Values, sums
from emulator.scenes.tissue import Fibres


@dataclass(frozen=True)
class Traction(Load):
    r"""Dead traction, a force per reference area that keeps its direction.

    Its potential is :math:`-\int t \cdot u\, dA` over the reference surface.

    Parameters
    ----------
    facet_set : the surface it acts on.
    traction : three components in kPa.
    """

    kind: ClassVar[str] = "traction"

    facet_set: str
    traction: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.traction) != 3 or not np.isfinite(self.traction).all():
            raise InputError(
                f"traction on '{self.facet_set}' is {self.traction}; give 3 finite numbers in kPa"
            )

    @override
    def dead_forces(self, grid: Discretisation) -> Mapping[str | None, np.ndarray]:
        mesh, facets = grid.mesh, grid.mesh.facet_set(self.facet_set)
        areas = nodal_areas(mesh.nodes[facets], facet_rule(mesh.order, 4))
        area = sums(len(mesh.nodes), facets, areas)
        return {None: area[:, None] * np.asarray(self.traction, dtype=float)}

    @override
    def on_loaded(
        self, grid: Discretisation, fibres: Fibres | None = None
    ) -> tuple[LocalForce, ...]:
        mesh = grid.mesh
        facets, rule = mesh.facet_set(self.facet_set), facet_rule(mesh.order, 4)

        def force(w: jax.Array, corners: jax.Array, _: Values) -> jax.Array:
            return nodal_areas(corners + w, rule)[:, None] * np.asarray(self.traction, dtype=float)

        return (LocalForce(facets, mesh.nodes[facets], force),)
