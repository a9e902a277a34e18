r"""Pressure on a surface; positive pushes into the tissue.

Exact for a cavity closed at a rim that does not move: the pressure does work on the volume alone,

.. math:: \Pi_p = -p\,[V(u) - V(0)], \qquad
          V = -\frac{1}{3} \int x \cdot n \, da + \text{lid}

with the normals of the facets pointing out of the tissue, into the cavity. The lid is fixed and
drops out. A rim may also slide in a plane of symmetry through the origin: the cone over the
opening, from the origin, then has no volume. Elsewhere a pressure that follows the surface has no
potential: see :mod:`emulator.scenes.loads.follower`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np

from emulator.core.errors import InputError
from emulator.geometry.discretisation import Discretisation
from emulator.geometry.facets import cone_volume, rim
from emulator.geometry.mesh import Mesh
from emulator.scenes.fibre_angles import Fibres
from emulator.scenes.loads.dead_pressure import DeadPressure, at_rest
from emulator.scenes.loads.follower import FollowerPressure
from emulator.scenes.loads.surface_pressure import SurfacePressure
from emulator.scenes.local_terms import LocalForce, LocalTerm, Values


@dataclass(frozen=True)
class CavityPressure(SurfacePressure):
    """Pressure in a cavity, exact (``-p V``); the rim of its wall must be held."""

    kind: ClassVar[str] = "cavity_pressure"

    @property
    def simpler(self) -> tuple[str, DeadPressure]:
        """The pressure on the wall as it is at rest."""
        return at_rest(self)

    @property
    def at_held_nodes(self) -> FollowerPressure:
        """The pressure on the wall alone: the lid's part in ``V`` acts on the held rim."""
        return FollowerPressure(self.facet_set, self.pressure, self.parameter)

    def check(self, mesh: Mesh, held: np.ndarray, displacement: np.ndarray) -> None:
        """Refuse a cavity whose rim is neither held nor slides in a plane through the origin."""
        edges = rim(mesh.facet_set(self.facet_set))
        stays = held[edges]  # (e, 2 or 3, 3)
        there = np.where(stays, mesh.nodes[edges] + displacement[edges], np.nan)
        in_symmetry_plane = (np.abs(there) <= 1e-9 * mesh.size).all(axis=1).any(axis=1)
        loose = np.unique(edges[~(stays.all(axis=(1, 2)) | in_symmetry_plane)])
        if loose.size:
            raise InputError(
                f"cavity '{self.facet_set}': rim node {loose[0]} ({loose.size} such) is not held, "
                "so -p V is not the potential of its pressure; hold the rim or use FollowerPressure"
            )

    def term(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalTerm:
        """The potential ``-p [V(u) - V(0)]``."""
        del fibres
        facets = grid.mesh.facet_set(self.facet_set)

        def energy(u: jax.Array, corners: jax.Array, values: Values) -> jax.Array:
            return -self.value(values) * (cone_volume(corners) - cone_volume(corners + u))

        return LocalTerm(facets, grid.mesh.nodes[facets], energy)

    def on_loaded(self, grid: Discretisation, fibres: Fibres | None = None) -> LocalForce:
        """The force on the known wall, whatever the shape at rest."""
        del fibres
        return self.at_held_nodes.on_loaded(grid)
